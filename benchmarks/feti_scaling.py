"""Total FETI against size: time, memory, steps and condition numbers at fixed H/h.

    python benchmarks/feti_scaling.py [--cells H/h] [--ways feti,whole] [Nr ...]

The beam on its half ring in one load step, Nh = Nr/2. `feti` tears it into subdomains,
`whole` is the dual of the whole; both go from the mesh to an answer with a certified
error below 1e-6, for which their tolerances differ. Each runs in a process of its own,
so that peaks are its own; `cpu` is what a busy machine can compare.

Of `feti`, what theory speaks of is measured apart from the search for the active set:

    kappa      condition number of PFP on supports and gluing, no contact, by Lanczos
    face       CG steps with the active rows known as equations, to a reduction of 1e-6
    face none  the same without a preconditioner

Prints a table, and the exponents of c·n^p with 95 % intervals.
"""

import argparse
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from time import perf_counter, process_time

import numpy as np
from scipy.stats import linregress, t

from mortarbench.harness import Mechanics, certify, no_rows
from mortarbench.problems.contact.bodies import factorise_clamped, factorise_floating
from mortarbench.problems.contact.node_to_segment import node_to_segment
from mortarbench.problems.contact.stepping import load_steps
from mortarbench.problems.duality.decomposed import decompose
from mortarbench.problems.duality.dualisation import dualise
from mortarbench.problems.duality.feti_dual import feti_dual
from mortarbench.problems.duality.monolithic import primal_qp
from mortarbench.problems.feti.distributed_dual import LocalDual
from mortarbench.problems.feti.local_bodies import certifier
from mortarbench.problems.feti.operator_arrays import dual_operator
from mortarbench.problems.feti.spectrum import spectra_over_ranks
from mortarbench.problems.feti.subdomains import Contact, on_one_process
from mortarbench.problems.models.beam_ring import bodies as bodies_of
from mortarbench.problems.models.beam_ring import model
from mortarbench.solvers.baselines.feti import FETI
from mortarbench.solvers.smalbe.solver import SMALBE

TOL = {"feti": 1e-7, "whole": 1e-8}  #: with which errors are certified to 1e-6
REDUCTION = 1e-6
STAGES = ("mesh", "dual", "prepare", "solve", "recover", "certify")


def one(way, Nr, cells):
    """Measure one size in this process; compiled loops are loaded before."""
    model(1, 1, 2, "strain")
    begun, marks = process_time(), [perf_counter()]

    def lap():
        marks.append(perf_counter())

    bodies = model(Nr, Nr // 2, Nr, "strain")
    u = np.zeros(bodies.mesh.dofs)
    primal = primal_qp(bodies, node_to_segment(bodies.mesh.points, u, *bodies.pairs[0]))
    lap()
    pieces = certify_by_subdomains = parts = None
    if way == "feti":
        of = bodies_of(Nr, Nr // 2, Nr, "strain")
        (stage,) = load_steps(1, 1, of.forces, of.fixed)
        contact = Contact(primal.G, primal.h, np.zeros(0))
        layout = of.shape.layout(cells)
        parts = decompose(of, layout, "orthonormal", stage, contact)
        own = on_one_process(parts)
        pieces, certify_by_subdomains = own.decomposed, certifier(own, primal.P)
        dual = feti_dual(pieces, primal)
    else:
        dual = dualise(primal, factorise_floating(bodies))
    lap()
    run = SMALBE().prepare(dual.qp, TOL[way])
    lap()
    s = run()
    lap()
    back = dual.recover(s)
    lap()
    mechanics = Mechanics(
        primal=primal, back=dual.recover, factorise=lambda: factorise_clamped(bodies),
        certify_by_subdomains=certify_by_subdomains,
        mesh_size=bodies.mesh_size, rigid=bodies.rigid, names=bodies.names,
    )  # fmt: skip
    bound = certify(mechanics, back).bound
    lap()
    cpu = process_time() - begun
    status = Path("/proc/self/status").read_text().splitlines()
    peak_kib = next(line.split()[1] for line in status if line.startswith("VmHWM"))
    found = {
        "way": way, "n": bodies.mesh.dofs, "m": dual.qp.q.size, "status": s.status,
        "bound": bound, **dict(zip(STAGES, np.diff(marks).tolist(), strict=True)),
        "total": marks[-1] - marks[0], "cpu": cpu, "peak_mib": int(peak_kib) / 1024,
        **s.counts,
    }  # fmt: skip
    if parts is None:
        return found
    empty = Contact(no_rows(bodies.mesh.dofs), np.zeros(0), np.zeros(0))
    bare = LocalDual(on_one_process(replace(parts, contact=empty))).share().qp
    return found | known_face(pieces, bare, dual.qp, s)


def known_face(pieces, bare, qp, s):
    """Measure κ without contact, and CG steps with the final active rows known."""
    equality = np.arange(qp.q.size) < pieces.equalities
    active = equality | (s.x > 1e-6 * s.x[~equality].max())
    (alone,) = spectra_over_ranks(bare.P, bare.A, tol=1e-3)
    m = int(active.sum())
    F = dual_operator(pieces.B[active], pieces.domains, pieces.equalities)
    face = replace(
        qp, P=F, q=qp.q[active], A=qp.A[:, active], G=no_rows(m),
        lb=np.full(m, -np.inf), ub=np.full(m, np.inf),
    )  # fmt: skip
    steps = {
        name: FETI(preconditioner=kind)
        .prepare(face, REDUCTION)()
        .counts["steps_to_tol"]
        for name, kind in (("face", "dirichlet"), ("face none", "none"))
    }
    return {"kappa": alone.condition, **steps}


def exponent(n, values):
    """Fit values = c·n^p; return p and the half width of its 95 % interval."""
    fit = linregress(np.log(n), np.log(values))
    return fit.slope, t.ppf(0.975, len(n) - 2) * fit.stderr


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("Nr", type=int, nargs="*", default=[16, 24, 48, 96, 240])
    parser.add_argument("--cells", type=int, default=8)
    parser.add_argument("--ways", default="feti,whole")
    parser.add_argument("--one", action="store_true", help="in this process, as JSON")
    given = parser.parse_args()
    if given.one:
        print(json.dumps(one(given.ways, given.Nr[0], given.cells)))
        return
    rows = []
    for Nr in given.Nr:
        for way in given.ways.split(","):
            options = ["--one", "--ways", way, "--cells", str(given.cells), str(Nr)]
            child = [sys.executable, __file__, *options]
            rows.append(json.loads(subprocess.check_output(child, text=True)))
            print("  ".join(f"{k}={v:.4g}" if isinstance(v, float) else f"{k}={v}"
                            for k, v in rows[-1].items()), flush=True)  # fmt: skip
    for way in given.ways.split(","):
        own = [row for row in rows if row["way"] == way]
        for what in own[0]:
            values = [row.get(what) for row in own]
            if (
                what == "n"
                or len(own) < 3
                or not all(isinstance(v, int | float) and v > 0 for v in values)
            ):
                continue
            p, half = exponent([row["n"] for row in own], values)
            print(f"{way} {what:>22} ~ n^{p:.3f} ± {half:.3f}")


if __name__ == "__main__":
    main()
