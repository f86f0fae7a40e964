"""Tables of docs/performance.md on discs: solvers on Mindlin's problem.

    python -m benchmarks.discs products|ratios|time|conic

* products: numbers of products with P (of sweeps for nsgs) at tol 1e-8, for 88 to 1468
  discs.
* ratios: number of products of `smalbe` relative to the best other method except nsgs.
  The numbers are sensitive to small changes of the data. Each problem is therefore
  solved for ten values of the first estimate of ‖P‖, and for ten loads;
  estimates and loads deviate by up to 3 %.
* conic: processor times of `smalbe` and of conic solvers for a verified point.
* time: errors, error bound, peak memory and processor time of `smalbe` for up to 512²
  cells, and the ratio of this time to the time of the products alone. The two times are
  measured alternately. Set OMP_NUM_THREADS=1, because processor times of threads are
  added.
"""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from itertools import product
from time import process_time
from typing import Any
from unittest.mock import patch

import numpy as np
from numpy.typing import NDArray

import mortarbench as mb
from mortarbench.case import Case
from mortarbench.harness import QP, Verdict, verdict
from mortarbench.harness.operators import assembled
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.baselines import projected_gradient
from mortarbench.solvers.smalbe import driver, textbook
from mortarbench.solvers.smalbe.compiled import Product

TOL = 1e-8
CELLS = (12, 24, 36, 48)  #: cells per side, for 88, 376, 820 and 1468 discs
PERTURBED = np.linspace(0.97, 1.03, 10)  #: factors of the norm ‖P‖, or of the load
LARGE = (256, 512)  #: cells per side of problems in which P is an operator
ROUNDS = 5  #: number of alternating rounds in the measurement of times
CONIC = ("clarabel", "scs", "qoco")
METHODS = ("smalbe", "smalbe-paper", "projected-gradient", "nsgs")


def mindlin(cells: int, nu: float, Q: float) -> Case:
    """Build the tangential contact problem of Cattaneo and Mindlin.

    nu : Poisson's ratio
    Q : tangential force, relative to the limit μP of sliding
    """
    return mb.build(f"half-space/n={cells}/law=mindlin/nu={nu}/Q={Q}/dual")


def with_dense(qp: QP) -> QP:
    """Replace the operator P by its matrix."""
    return replace(qp, P=assembled(qp.P))


def count(name: str, qp: QP) -> int:
    """Solve a QP and verify the residuals; return the number of products or sweeps."""
    s = SOLVERS[name].prepare(qp, TOL)()
    residuals = kkt_residuals(qp, s)
    assert verdict(s.status, residuals, TOL) is Verdict.VERIFIED, (name, residuals)
    return s.counts["sweeps" if name == "nsgs" else "P_products"]


def products() -> None:
    """Print the numbers of products of all methods for ν = 0.3, Q/μP = 0.3 and 0.9."""
    for name in METHODS:
        pairs = [
            [count(name, with_dense(mindlin(n, 0.3, Q).qp)) for Q in (0.3, 0.9)]
            for n in CELLS
        ]
        print(f"| {name} |", " | ".join(f"{a} ({b})" for a, b in pairs), "|")


@contextmanager
def perturbed_norm(factor: float) -> Iterator[None]:
    """Multiply the first estimates of ‖P‖ by `factor`, in all methods except nsgs."""

    def norm(name: str, estimate: Any, *args: Any, **keys: Any) -> Any:
        result = estimate(*args, **keys)
        if not name:
            return result * factor
        power = -1 if name == "alpha" else 1
        return result._replace(**{name: getattr(result, name) * factor**power})

    with ExitStack() as stack:
        for module, function, name in (
            (driver, "by_lanczos", "norm"),
            (textbook, "lanczos", ""),
            (projected_gradient, "_start", "alpha"),
        ):
            estimate = partial(norm, name, getattr(module, function))
            stack.enter_context(patch.object(module, function, estimate))
        yield


def ratios() -> None:
    """Print ratios of products for all Q/μP and ν, with perturbed norms and loads."""
    names = [name for name in METHODS if name != "nsgs"]
    for kind in ("norms", "loads"):
        spent = []
        for nu, n in product((0.0, 0.3, 0.45), CELLS):
            of_size = []
            for Q in (0.1, 0.3, 0.5, 0.7, 0.9):
                qp = mindlin(n, nu, Q).qp
                for factor in PERTURBED:
                    norm, load = (factor, 1) if kind == "norms" else (1, factor)
                    with perturbed_norm(norm):
                        loaded = replace(qp, q=load * qp.q)
                        of_size.append([count(name, loaded) for name in names])
            means = np.exp(np.log(of_size).mean(axis=0))
            print(f"{kind}, ν = {nu}, {n}² cells:", _ratio(np.log(of_size)), end="; ")
            listed = zip(names, means, strict=True)
            print(", ".join(f"{name} {mean:.1f}" for name, mean in listed), flush=True)
            spent.append(of_size)
        logs = np.log(spent).reshape(-1, len(PERTURBED), len(names))
        print(kind, "problems:", _ratio(logs.mean(axis=1)), "solves:", _ratio(logs))


def _ratio(logs: NDArray[np.float64]) -> str:
    """Format the ratios of the first column to the least of the others.

    The text contains their geometric mean and their maximum.

    logs : logarithms; the last axis contains the columns
    """
    ratio = logs[..., 0] - logs[..., 1:].min(axis=-1)
    return f"{np.exp(ratio.mean()):.2f}, at most {np.exp(ratio.max()):.2f}"


def time() -> None:
    """Print errors, memory and times of `smalbe` for up to 512² cells.

    The last column is the ratio of the time of a solve to the time of its products
    alone.
    """
    header = "cells, discs", "ν", "Q/μP", "error of c/a", "of Q", "bound", "peak memory"
    print(*header, "products", "solve", "ratio", sep=" | ")
    forces = (0.1, 0.3, 0.5, 0.7, 0.9)
    cases = [(CELLS[-1], 0.3, 0.5), *((n, 0.0, Q) for n in LARGE for Q in forces)]
    for n, nu, Q in [*cases, *((n, 0.3, 0.5) for n in LARGE)]:
        case = mindlin(n, nu, Q)
        answer = mb.solve(case, "smalbe", tol=TOL)
        assert answer.verdict is Verdict.VERIFIED, answer.residuals
        qp = with_dense(case.qp) if n in CELLS else case.qp
        F, v, solves, ratios = Product(qp.P, qp.q.size), qp.q.copy(), [], []
        for _ in range(ROUNDS):
            began = process_time()
            s = SOLVERS["smalbe"].prepare(qp, TOL)()
            solves.append(process_time() - began)
            began = process_time()
            for _ in range(s.counts["P_products"]):
                F(v)
            ratios.append(solves[-1] / (process_time() - began))
        of = answer.quantities
        print(
            f"{n}², {of['cells']} | {nu} | {Q} | {of['c_over_a_error']:.2%} | "
            f"{of['force_error']:.0e} | {answer.energy_bound:.1e} | "
            f"{answer.record.peak_mib / 1024:.2f} GiB | {s.counts['P_products']} | "
            f"{np.median(solves):.2f} s | {np.median(ratios):.2f}",
            flush=True,
        )


def conic() -> None:
    """Print processor times to a point that is verified at 1e-8, ν = 0.3, Q/μP = 0.5.

    Each solver runs at tolerances 1e-6, 1e-8, … until its point is verified. The
    printed time is the time of the last run.
    """
    for n, name in product(CELLS, ("smalbe", *CONIC)):
        qp, result = with_dense(mindlin(n, 0.3, 0.5).qp), "not verified"
        for tol in (1e-6, 1e-8, 1e-10, 1e-12):
            began = process_time()
            s = SOLVERS[name].prepare(qp, tol)()
            ms = 1e3 * (process_time() - began)
            answer = mb.verify(qp, s.x, y=s.y, z=s.z, z_box=s.z_box, tol=TOL)
            if answer.verdict is Verdict.VERIFIED:
                result = f"{ms:.3g} ms (tol {tol:.0e})"
                break
        print(f"{qp.sets[1].block.size // 2} discs, {name}: {result}", flush=True)


if __name__ == "__main__":
    parser = ArgumentParser(description="Compare solvers on friction discs.")
    parser.add_argument("table", choices=["products", "ratios", "time", "conic"])
    tables = {"products": products, "ratios": ratios, "time": time, "conic": conic}
    tables[parser.parse_args().table]()
