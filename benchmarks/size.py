"""Scaling of time and peak memory of one load step, from mesh to recovery.

    make size        or   .venv/bin/python benchmarks/size.py [FORM] [Nr ...]

The case is beam-ring with Nh = Nr/2. Each size runs in a separate process, so that its
peak memory is known. The script prints a table and, for each quantity, the exponent p
of a fit c·n^p with its 95 % interval, where n is the number of displacements.
Logarithms are fitted by least squares.
"""

import json
import subprocess
import sys
from pathlib import Path
from time import perf_counter

import numpy as np
from scipy.stats import linregress, t

from mortarbench.problems.contact.bodies import factorise_clamped, factorise_floating
from mortarbench.problems.contact.node_to_facet import node_to_facet
from mortarbench.problems.duality.dualisation import dual_bounds, dualise
from mortarbench.problems.duality.monolithic import primal_qp
from mortarbench.problems.families.beam_ring import model
from mortarbench.solvers.smalbe.solver import SMALBE

WAYS = {
    "dual": (factorise_floating, dualise),
    "dual-bounds": (factorise_clamped, dual_bounds),
}


def one(form, Nr):
    """Measure one size in this process; return sizes, times in s and peak memory."""
    model(1, 1, 2, "strain")  # loads compiled modules before the clock starts
    factorise, transform = WAYS[form]
    marks = [perf_counter()]

    def lap():
        marks.append(perf_counter())

    bodies = model(Nr, Nr // 2, Nr, "strain")
    lap()
    inverse = factorise(bodies)
    lap()
    u = np.zeros(bodies.mesh.dofs)
    slave, master, *_ = bodies.pairs[0]
    rows = node_to_facet(bodies.mesh.points, u, slave, master)
    dual = transform(primal_qp(bodies, rows), inverse)
    lap()
    s = SMALBE().prepare(dual.qp, 1e-8)()
    lap()
    dual.recover(s)
    lap()
    status = Path("/proc/self/status").read_text().splitlines()
    peak_kib = next(line.split()[1] for line in status if line.startswith("VmHWM"))
    assembly, factor, rows_and_dual, solve, recover = np.diff(marks).tolist()
    return {
        "n": bodies.mesh.dofs, "m": dual.qp.q.size, "status": s.status,
        "products": s.counts["P_products"], "assembly": assembly, "factor": factor,
        "dual": rows_and_dual, "SMALBE": solve, "recovery": recover,
        "total": marks[-1] - marks[0],
        "peak_mib": int(peak_kib) / 1024,
    }  # fmt: skip


def exponent(n, values):
    """Fit values = c·n^p; return p and the half-width of its 95 % interval."""
    fit = linregress(np.log(n), np.log(values))
    return fit.slope, t.ppf(0.975, len(n) - 2) * fit.stderr


def main(form="dual", *sizes):
    rows = []
    for Nr in sizes or (16, 30, 60, 120, 240):
        child = [sys.executable, __file__, "--one", form, str(Nr)]
        rows.append(json.loads(subprocess.check_output(child, text=True)))
        print("  ".join(f"{k}={v:.4g}" if isinstance(v, float) else f"{k}={v}"
                        for k, v in rows[-1].items()), flush=True)  # fmt: skip
    n = np.array([row["n"] for row in rows])
    parts = ("assembly", "factor", "dual", "SMALBE", "recovery", "total", "peak_mib")
    for what in parts:
        p, half = exponent(n, np.array([row[what] for row in rows]))
        print(f"{what:>10} ~ n^{p:.2f} ± {half:.2f}")


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        print(json.dumps(one(sys.argv[2], int(sys.argv[3]))))
    else:
        main(*sys.argv[1:])
