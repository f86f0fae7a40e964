"""Products of in-house solvers on Mindlin's problem: tables of docs/smalbe-discs.md.

    python -m benchmarks.discs products|ratios|time

* products: products with P (sweeps of nsgs) at tol 1e-8, over 88 to 1468 discs.
* ratios: products of `smalbe` over those of the best other method.
* time: processor time of `smalbe` over that of its products alone, measured
  alternately (set OMP_NUM_THREADS=1, as the times of threads add up).
"""

from __future__ import annotations

from argparse import ArgumentParser
from dataclasses import replace
from time import process_time

import numpy as np

import mortarbench as mb
from mortarbench.harness import QP
from mortarbench.harness.operators import assembled
from mortarbench.harness.plugin import Solver
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.baselines.apgd import AcceleratedGradient
from mortarbench.solvers.smalbe.compiled import Product

TOL = 1e-8
CELLS = (12, 24, 36, 48)  #: per side: 88, 376, 820 and 1468 discs
LARGE = (256, 512)  #: cells per side, P an operator
ROUNDS = 5  #: of the measurement of times
METHODS: dict[str, Solver] = {
    **{
        name: SOLVERS[name] for name in ("smalbe", "smalbe-paper", "projected-gradient")
    },
    "apgd": SOLVERS["apgd"],
    "apgd, fixed step": AcceleratedGradient(shrink=1.0, growth=1.05),
    "nsgs": SOLVERS["nsgs"],
}


def mindlin(cells: int, nu: float, Q: float, *, dense: bool = True) -> QP:
    """Build the tangential problem of Cattaneo and Mindlin."""
    qp = mb.build(f"half-space/n={cells}/law=mindlin/nu={nu}/Q={Q}/dual").qp
    return replace(qp, P=assembled(qp.P)) if dense else qp


def count(name: str, qp: QP) -> int:
    """Solve and verify; return the products with P, or the sweeps."""
    s = METHODS[name].prepare(qp, TOL)()
    answer = mb.verify(qp, s.x, y=s.y, z=s.z, z_box=s.z_box, tol=TOL)
    assert answer.verdict.value == "verified", (name, answer.residuals)
    return s.counts["sweeps" if name == "nsgs" else "P_products"]


def products() -> None:
    """Print the products of all methods, ν = 0.3, Q/μP = 0.3 and 0.9."""
    for name in METHODS:
        pairs = [[count(name, mindlin(n, 0.3, Q)) for Q in (0.3, 0.9)] for n in CELLS]
        print(f"| {name} |", " | ".join(f"{a} ({b})" for a, b in pairs), "|")


def ratios() -> None:
    """Print the ratios of products over all Q/μP and ν."""
    others = [name for name in METHODS if name not in ("smalbe", "nsgs")]
    values = []
    for nu in (0.0, 0.3, 0.45):
        for n in CELLS:
            for Q in (0.1, 0.3, 0.5, 0.7, 0.9):
                qp = mindlin(n, nu, Q)
                best = min(count(name, qp) for name in others)
                values.append(count("smalbe", qp) / best)
    mean = float(np.exp(np.mean(np.log(values))))
    print(f"{len(values)} cases: geometric mean {mean:.2f}, largest {max(values):.2f}")


def time() -> None:
    """Print the ratios of times, ν = 0.3, Q/μP = 0.5."""
    cases = [(CELLS[-1], True), *((n, False) for n in LARGE)]
    for n, dense in cases:
        qp = mindlin(n, 0.3, 0.5, dense=dense)
        F, v, measured = Product(qp.P, qp.q.size), qp.q.copy(), []
        for _ in range(ROUNDS):
            began = process_time()
            s = METHODS["smalbe"].prepare(qp, TOL)()
            solved, calls = process_time() - began, s.counts["P_products"]
            began = process_time()
            for _ in range(calls):
                F(v)
            measured.append(solved / (process_time() - began))
        sizes = qp.sets[1].block.size // 2, calls
        print(sizes, " ".join(f"{ratio:.2f}" for ratio in sorted(measured)))


if __name__ == "__main__":
    parser = ArgumentParser(description="Solvers on discs of friction.")
    parser.add_argument("table", choices=["products", "ratios", "time"])
    {"products": products, "ratios": ratios, "time": time}[parser.parse_args().table]()
