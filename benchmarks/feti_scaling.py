"""Scaling of Total FETI: time, memory, steps and condition numbers at fixed H/h.

    python benchmarks/feti_scaling.py [--cells H/h] [--ways feti,whole] [Nr ...]
    python benchmarks/feti_scaling.py --family cube-wall [--cells H/h] [n ...]

The problem is the beam on its half ring in one load step, Nh = Nr/2, or the cube of n³
hexahedra beside a wall. With `feti`, the bodies are decomposed into subdomains; `whole`
is the dual QP of undivided bodies. Both variants are timed from the mesh to an answer
with a certified error below 1e-6; the necessary tolerances of the two variants differ.
Each measurement runs in a separate process, so that its peak memory is known. `cpu` is
processor time, for comparisons on a busy machine.

For `feti`, the script also measures the following quantities of the theory, which do
not depend on the search for the active set.

    kappa            condition number of PFP without contact, by Lanczos; P projects
                     onto the kernel of the equality rows, and F is the dual operator
                     of supports and gluing
    kappa_dirichlet  condition number with the Dirichlet preconditioner
    face             CG steps with this preconditioner that reduce the residual by the
                     factor 1e-6; the active contact rows are equality rows
    face none        CG steps for the same problem without a preconditioner

The script prints a table and, for each positive quantity measured at three or more
sizes, the exponent p of a fit c·n^p with its 95 % interval, where n is the number of
displacements.
"""

import argparse
import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from time import perf_counter, process_time

import numpy as np
from scipy.sparse import csc_matrix, csr_array
from scipy.sparse.linalg import LinearOperator, cg
from scipy.stats import linregress, t
from sksparse.cholmod import cholesky

from mortarbench.harness import Mechanics, certify, no_rows
from mortarbench.problems import PROBLEMS
from mortarbench.problems.contact.bodies import factorise_clamped, factorise_floating
from mortarbench.problems.duality.decomposed import decompose, subdivided
from mortarbench.problems.duality.dualisation import dualise
from mortarbench.problems.duality.feti_dual import TornDual, feti_dual
from mortarbench.problems.duality.monolithic import primal_qp
from mortarbench.problems.feti.mechanics import torn_mechanics
from mortarbench.problems.feti.served import Served
from mortarbench.problems.feti.spectrum import spectra
from mortarbench.problems.feti.subdomains import Contact, TornBodies
from mortarbench.solvers.smalbe.solver import SMALBE

TOL = {"feti": 1e-7, "whole": 1e-8}  #: tolerances for certified errors below 1e-6
REDUCTION = 1e-6
#: keys of a case as a function of its size, and sizes of about 10⁴ to 10⁶ displacements
FAMILIES = {
    "beam-ring": (
        lambda Nr: {"Nr": Nr, "Nh": Nr // 2, "radial": Nr, "steps": 1},
        [16, 24, 48, 96, 240],
    ),
    "cube-wall": (lambda n: {"n": n}, [16, 24, 32, 48, 72]),
}
STAGES = ("mesh", "dual", "prepare", "solve", "recover", "certify")


def problem_of(family, size):
    """Return the contact problem of one size."""
    keys, _ = FAMILIES[family]
    return PROBLEMS[family].with_keys(**keys(size)).contact_problem()


def one(way, family, size, cells):
    """Measure one size in this process.

    way : ``feti`` or ``whole``
    size : Nr or n
    cells : H/h, number of elements along an edge of a subdomain
    """
    # loads compiled modules before the clock starts
    assert problem_of(family, 2).bodies.assembled
    cpu_start, marks = process_time(), [perf_counter()]

    def lap():
        marks.append(perf_counter())

    problem = problem_of(family, size)
    of, (stage,) = problem.bodies, problem.stages
    bodies = of.assembled
    rows = problem.linearise(bodies, stage.laws)(np.zeros(bodies.mesh.dofs))
    primal = primal_qp(bodies, rows)
    lap()
    served = subdomains = None
    if way == "feti":
        contact = Contact(csr_array(primal.G), primal.h, np.zeros(0))
        layout = subdivided(of.shape, cells)
        parts = decompose(of, layout, "orthonormal", stage, contact)
        served = Served(TornBodies(parts))
        subdomains = torn_mechanics(served, primal.P)
        dual = feti_dual(served, primal)
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
        primal=primal, to_primal=dual.recover,
        factorise=lambda: factorise_clamped(bodies),
        subdomains=subdomains,
        rigid=bodies.rigid, names=bodies.names,
    )  # fmt: skip
    bound = certify(mechanics, back).bound
    lap()
    cpu = process_time() - cpu_start
    status = Path("/proc/self/status").read_text().splitlines()
    peak_kib = next(line.split()[1] for line in status if line.startswith("VmHWM"))
    results = {
        "way": way, "n": bodies.mesh.dofs, "m": dual.qp.q.size, "status": s.status,
        "bound": bound, **dict(zip(STAGES, np.diff(marks).tolist(), strict=True)),
        "total": marks[-1] - marks[0], "cpu": cpu, "peak_mib": int(peak_kib) / 1024,
        **s.counts,
    }  # fmt: skip
    if served is None:
        return results
    return results | final_face(served, dual.qp, s)


def final_face(served, qp, s):
    """Return the quantities of the theory described in the docstring of the module.

    served : decomposed bodies
    qp, s : dual QP and its solution
    """
    torn, d = served.torn, served.torn.problem.components
    empty = Contact(no_rows(d * torn.problem.layout.nodes), *np.zeros((2, 0)))
    alone = Served(torn.with_problem(replace(torn.problem, contact=empty)))
    unbounded = TornDual(alone).qp
    equality = np.arange(qp.q.size) < torn.rows.equalities
    active = equality | (s.x > 1e-6 * s.x[~equality].max())
    names = [None, ("dirichlet", "multiplicity")]
    plain, dirichlet = spectra(unbounded, alone.torn.rows.B, names, tol=1e-3)
    m = int(active.sum())
    F = replace(served.operator, B=torn.rows.B[active])
    G = qp.A[:, active]
    coarse = cholesky(csc_matrix(G @ G.T))

    def projected(M):
        def project(v):
            return v - G.T @ coarse(G @ v)

        return LinearOperator((m, m), lambda v: project(M @ project(v)), dtype=float)

    feasible = G.T @ coarse(qp.b)
    residual = -(qp.q[active] + F(feasible))
    M = F.preconditioner("dirichlet", "stiffness")
    product = LinearOperator((m, m), F, dtype=float)
    dirichlet_map = LinearOperator((m, m), M, dtype=float)
    identity = LinearOperator((m, m), lambda v: v, dtype=float)
    steps = {}
    for name, of in (("face", dirichlet_map), ("face none", identity)):
        norms = []
        cg(
            projected(product), projected(identity) @ residual, M=projected(of),
            rtol=REDUCTION, callback=norms.append,
        )  # fmt: skip
        steps[name] = len(norms)
    kappas = {"kappa": plain.condition, "kappa_dirichlet": dirichlet.condition}
    return {**kappas, **steps}


def exponent(n, values):
    """Fit values = c·n^p; return p and the half-width of its 95 % interval."""
    fit = linregress(np.log(n), np.log(values))
    return fit.slope, t.ppf(0.975, len(n) - 2) * fit.stderr


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("sizes", type=int, nargs="*", help="Nr or n")
    parser.add_argument("--family", choices=FAMILIES, default="beam-ring")
    parser.add_argument("--cells", type=int, default=8)
    parser.add_argument("--ways", default="feti,whole")
    parser.add_argument(
        "--one",
        action="store_true",
        help="measure one size in this process, and print JSON",
    )
    args = parser.parse_args()
    if args.one:
        print(json.dumps(one(args.ways, args.family, args.sizes[0], args.cells)))
        return
    rows = []
    for size in args.sizes or FAMILIES[args.family][1]:
        for way in args.ways.split(","):
            options = ["--family", args.family, "--ways", way, "--cells", args.cells]
            child = [sys.executable, __file__, "--one", *map(str, options), str(size)]
            rows.append(json.loads(subprocess.check_output(child, text=True)))
            print("  ".join(f"{k}={v:.4g}" if isinstance(v, float) else f"{k}={v}"
                            for k, v in rows[-1].items()), flush=True)  # fmt: skip
    for way in args.ways.split(","):
        way_rows = [row for row in rows if row["way"] == way]
        for name in way_rows[0]:
            values = [row.get(name) for row in way_rows]
            if (
                name == "n"
                or len(way_rows) < 3
                or not all(isinstance(v, int | float) and v > 0 for v in values)
            ):
                continue
            p, half = exponent([row["n"] for row in way_rows], values)
            print(f"{way} {name:>22} ~ n^{p:.3f} ± {half:.3f}")


if __name__ == "__main__":
    main()
