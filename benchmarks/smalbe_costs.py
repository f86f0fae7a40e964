"""Costs of SMALBE relative to its products, and races with other solvers.

    python -m benchmarks.smalbe_costs dense|sparse|subdomains|kept
    python -m benchmarks.smalbe_costs race CASE SOLVER[,SOLVER…] ROUNDS [TOL[,TOL…]]

* dense: times to prepare and to solve dense duals, and the time of a product with F.
  The time of a solve is compared with the bound 1.5·T + 100 µs. T is the number of
  products times the time of a product in `smalbe` or in `dsymv` of BLAS, whichever is
  smaller.
* sparse: time of a solve without incomplete factors, divided by its number of products,
  in units of one product plus five vector operations w += v.
* subdomains: times to prepare and solve duals of bodies in subdomains, relative to the
  time of all products and all applications of the preconditioner. An earlier solve
  with the same operator has assembled the blocks.
* kept: solves with and without recycling of CG directions.
* race: times to prepare and solve a case with several solvers; answers are verified.

Runs that are compared with each other alternate in one process. Times are processor
times of this process; set OMP_NUM_THREADS=1, because the times of threads are added.
The script prints the median of the runs. Except in `subdomains`, it
also prints the median of the fastest tenth, on which other programs have less
influence.
"""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Callable
from dataclasses import replace
from time import process_time

import numpy as np
from scipy.linalg.blas import dsymv

import mortarbench as mb
from mortarbench.harness import QP, InputError, Solution
from mortarbench.harness.errors import unknown
from mortarbench.harness.plugin import Solver
from mortarbench.harness.record import VERIFIED_FACTOR
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems import PROBLEMS
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe.compiled import Product

DUALS = {
    "dual": [(12, 6, 5), (12, 7, 5), (24, 12, 10), (30, 15, 10), (60, 30, 5)],
    "dual-bounds": [(12, 6, 5), (12, 7, 5), (24, 12, 10), (30, 15, 10), (60, 30, 5)],
}  #: values of Nr, Nh and step of beam-ring, by form
LARGE = {
    "journal-bearing": {"n": 300},
    "obstacle": {"dim": 2, "n": 257, "shape": "hemisphere"},
    "torsion": {"n": 100},
}
SUBDOMAINS = (
    "membranes/S=2/n=8/dual", "membranes/S=4/n=8/dual", "membranes/S=8/n=8/dual",
    "membranes/S=16/n=16/dual", "beam-ring/Nr=16/Nh=8/feti=8/dual",
    "beam-ring/Nr=56/Nh=28/feti=16/dual",
)  # fmt: skip
KEPT = [("dual", 12, 6, 5), ("dual", 60, 30, 5), ("dual-bounds", 60, 30, 5)]
#: number of products that are timed together, because a single product is too short
REPEATS = 20

#: by name, the median time and the median of the fastest tenth, in s
Times = dict[str, tuple[float, float]]


def in_turn(rounds: int, **calls: Callable[[], float]) -> Times:
    """Run calls alternately, and return their times by name.

    rounds : number of runs of each call
    calls : functions that return their own time in s
    """
    spent: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            spent[name].append(call())
    return {
        name: (
            float(np.median(s)),
            float(np.median(sorted(s)[: max(1, len(s) // 10)])),
        )
        for name, s in spent.items()
    }


def timed(call: Callable[[], object], repeats: int = 1) -> Callable[[], float]:
    """Return a function that runs `call` and returns its mean time in s.

    repeats : number of runs over which the mean is taken
    """

    def run() -> float:
        start = process_time()
        for _ in range(repeats):
            call()
        return (process_time() - start) / repeats

    return run


def beam_ring(form: str, Nr: int, Nh: int, step: int) -> QP:
    """Return a QP of the paper's benchmark, a beam on a half ring."""
    family = PROBLEMS["beam-ring"]
    configured = family.with_keys(Nr=Nr, Nh=Nh, step=step)
    return configured.build(form, reference_solution).qp


def dense(tol: float = 1e-6) -> None:
    """Print times of preparation, solution and products of dense duals."""
    print("form m | products of the solve, of preparing | a product | prepare | solve")
    for form, sizes in DUALS.items():
        for size in sizes:
            _dense(form, beam_ring(form, *size), tol)


def _dense(form: str, qp: QP, tol: float) -> None:
    solver, n = SOLVERS["smalbe"], qp.q.size
    v, P, blas = np.ones(n), Product(qp.P, n), np.asarray(qp.P).T
    ready: list[Callable[[], Solution]] = []
    before = _products_of_preparing(qp, tol)
    spent = solver.prepare(qp, tol)().counts["P_products"] - before
    times = in_turn(
        150 if n > 600 else 600,
        ours=timed(lambda: P(v), REPEATS),
        dsymv=timed(lambda: dsymv(1.0, blas, v, lower=1), REPEATS),
        prepare=timed(lambda: ready.append(solver.prepare(qp, tol))),
        solve=timed(lambda: ready.pop()()),
    )
    cells = []
    for k in (0, 1):
        product = min(times["ours"][k], times["dsymv"][k])
        prepare, solve = times["prepare"][k], times["solve"][k]
        cells.append(
            f"{1e6 * product:.1f} µs, {1e6 * prepare:.0f} µs, {1e6 * solve:.0f} µs, "
            f"solve/bound {solve / (1.5 * spent * product + 100e-6):.2f}, "
            f"prepare/solve {prepare / solve:.2f}"
        )
    print(f"{form} {n} | {spent}, {before} | {cells[0]} | fast: {cells[1]}", flush=True)


def _products_of_preparing(qp: QP, tol: float) -> int:
    """Return the number of products in `prepare`.

    The number is obtained from the counts of a solve that is stopped at once.
    """
    s = replace(SOLVERS["smalbe"], max_steps=1).prepare(qp, tol)()
    # subtract the products of the steps, of the starting point and of the residuals
    return s.counts["P_products"] - s.iterations - 2


def sparse(tol: float = 1e-6) -> None:
    """Print times per product of large sparse problems, without incomplete factors."""
    solver = replace(SOLVERS["smalbe"], preconditioner="model")
    for name, params in LARGE.items():
        family = PROBLEMS[name]
        case = family.with_keys(**params).build(family.forms[0], reference_solution)
        _sparse(name, case.qp, solver, tol)


def _sparse(name: str, qp: QP, solver: Solver, tol: float) -> None:
    n = qp.q.size
    P, v, w = Product(qp.P, n), np.ones(n), np.ones(n)

    def passes() -> None:
        for _ in range(5):
            np.add(v, w, out=w)

    spent = solver.prepare(qp, tol)().counts["P_products"]
    times = in_turn(
        15 if n > 20_000 else 60,
        cold_product=timed(lambda: P(v)),
        cold_passes=timed(passes),
        product=timed(lambda: P(v), 5 * REPEATS),
        passes=timed(passes, 5 * REPEATS),
        scipy=timed(lambda: qp.P @ v, REPEATS),
        whole=timed(lambda: solver.prepare(qp, tol)()),
    )
    for k, which in enumerate(("medians", "fastest tenth")):
        us = {name: 1e6 * seconds[k] for name, seconds in times.items()}
        step = us["whole"] / spent
        unit = us["product"] + us["passes"]
        cold = us["cold_product"] + us["cold_passes"]
        print(
            f"{name} n={n}, {which}: {spent} products, {us['whole'] / 1e3:.1f} ms, "
            f"{step:.1f} µs each; product {us['product']:.1f} µs, SciPy's "
            f"{us['scipy']:.1f} µs, five passes {us['passes']:.1f} µs; ratio "
            f"{step / unit:.2f}; with caches as a solve leaves them "
            f"{us['cold_product']:.1f} µs, {us['cold_passes']:.1f} µs, "
            f"{step / cold:.2f}",
            flush=True,
        )


def subdomains(tol: float = 1e-6) -> None:
    """Print times of duals of bodies in subdomains, whose blocks are assembled."""
    print(
        "case, m | products, applications of the preconditioner | one of each | "
        "prepare, solve | together in units of these | KKT residual"
    )
    for case in SUBDOMAINS:
        _subdomains(case, mb.build(case).qp, tol)


def _subdomains(case: str, qp: QP, tol: float) -> None:
    solver, v = SOLVERS["smalbe"], np.ones(qp.q.size)
    s = solver.prepare(qp, tol)()
    products = s.counts["P_products"]
    applications = s.counts["preconditioner_applies"]
    P, F = Product(qp.P, v.size), qp.P.build()
    M = F.preconditioner("dirichlet", "stiffness")
    ready: list[Callable[[], Solution]] = []
    times = in_turn(
        60 if qp.q.size < 5000 else 20,
        product=timed(lambda: P(v), REPEATS),
        application=timed(lambda: M(v), REPEATS),
        warm=timed(lambda: solver.prepare(qp, tol)()),
        prepare=timed(lambda: ready.append(solver.prepare(qp, tol))),
        solve=timed(lambda: ready.pop()()),
    )
    us = {name: 1e6 * seconds for name, (seconds, _) in times.items()}
    whole = us["prepare"] + us["solve"]
    unit = products * us["product"] + applications * us["application"]
    print(
        f"{case} {qp.q.size} | {products}, {applications} | {us['product']:.1f}, "
        f"{us['application']:.1f} µs | {us['prepare']:.0f}, {us['solve']:.0f} µs | "
        f"{whole / unit:.1f} | {kkt_residuals(qp, s).worst:.1e}",
        flush=True,
    )


def kept() -> None:
    """Print times of duals with and without recycling of CG search directions."""
    for form, *size in KEPT:
        for tol in (1e-6, 1e-8):
            _kept(form, beam_ring(form, *size), tol)


def _kept(form: str, qp: QP, tol: float) -> None:
    solvers = {
        "kept": SOLVERS["smalbe"],
        "forgotten": replace(SOLVERS["smalbe"], recycle=False),
    }
    products = {
        name: s.prepare(qp, tol)().counts["P_products"] for name, s in solvers.items()
    }
    times = in_turn(
        60 if qp.q.size > 600 else 400,
        **{
            name: lambda s=s: timed(s.prepare(qp, tol))() for name, s in solvers.items()
        },
    )
    for k, which in enumerate(("medians", "fastest tenth")):
        ms = {name: 1e3 * seconds[k] for name, seconds in times.items()}
        print(
            f"{form} m={qp.q.size} {tol:.0e} {which}: kept {ms['kept']:.3f} ms "
            f"({products['kept']}), forgotten {ms['forgotten']:.3f} ms "
            f"({products['forgotten']})",
            flush=True,
        )


def positive(text: str) -> float:
    """Convert the text of a tolerance to a positive number.

    Raises
    ------
    InputError
        If the text is not a positive number.

    """
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < np.inf:
        raise InputError(f"tolerance {text!r}; expected a positive number")
    return value


def race(case: str, solvers: str, rounds: int, tolerances: str) -> None:
    """Print times of several solvers on a case, at each tolerance.

    case : name of the case
    solvers, tolerances : lists separated by commas
    rounds : number of alternating rounds

    Raises
    ------
    InputError
        If a solver or the case does not exist, or if `rounds` or a tolerance is not
        positive.

    """
    names = solvers.split(",")
    for name in names:
        if name not in SOLVERS:
            raise unknown("solver", name, SOLVERS)
    if rounds < 1:
        raise InputError(f"{rounds} rounds; expected at least one")
    qp = mb.build(case).qp
    for tol in map(positive, tolerances.split(",")):
        times = in_turn(
            rounds,
            **{
                name: timed(lambda name=name, tol=tol: SOLVERS[name].prepare(qp, tol)())
                for name in names
            },
        )
        for name, (typical, fast) in times.items():
            s = SOLVERS[name].prepare(qp, tol)()
            verified = kkt_residuals(qp, s).worst <= VERIFIED_FACTOR * tol
            print(
                f"{case} {tol:.0e} {name}: {1e3 * typical:.3g} ms, fastest tenth "
                f"{1e3 * fast:.3g} ms, {s.counts.get('P_products', 'no')} products"
                f"{'' if verified else ', NOT VERIFIED'}",
                flush=True,
            )


def main() -> None:
    """Parse the command line and print the table."""
    parser = ArgumentParser(description="Measure costs of a solve with SMALBE.")
    tables = parser.add_subparsers(dest="table", required=True)
    for name in ("dense", "sparse", "subdomains", "kept"):
        tables.add_parser(name)
    race_parser = tables.add_parser("race", help="compare several solvers on a case")
    race_parser.add_argument("case")
    race_parser.add_argument("solvers", help="names, separated by commas")
    race_parser.add_argument("rounds", type=int)
    race_parser.add_argument("tolerances", nargs="?", default="1e-6,1e-8")
    arguments = vars(parser.parse_args())
    functions = {
        "dense": dense, "sparse": sparse, "subdomains": subdomains, "kept": kept,
        "race": race,
    }  # fmt: skip
    try:
        functions[arguments.pop("table")](**arguments)
    except InputError as e:
        parser.error(str(e))


if __name__ == "__main__":
    main()
