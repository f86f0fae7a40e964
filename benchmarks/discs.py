"""Products of in-house solvers on Mindlin's problem: tables of docs/smalbe-discs.md.

    python -m benchmarks.discs products|ratios|time|conic

* products: products with P (sweeps of nsgs) at tol 1e-8, over 88 to 1468 discs.
* ratios: products of `smalbe` over those of the best other method. As such steps
  amplify small changes, each problem is solved with ten norms in the first step, and
  with ten loads, that differ by up to 3 %.
* conic: processor times of `smalbe` and of conic solvers to a verified point.
* time: processor time of `smalbe` over that of its products alone, measured
  alternately (set OMP_NUM_THREADS=1, as the times of threads add up).
"""

from __future__ import annotations

from argparse import ArgumentParser
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from time import process_time
from typing import Any
from unittest.mock import patch

import numpy as np

import mortarbench as mb
from mortarbench.harness import QP
from mortarbench.harness.operators import assembled
from mortarbench.harness.plugin import Solver
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.baselines import apgd, projected_gradient
from mortarbench.solvers.baselines.apgd import AcceleratedGradient
from mortarbench.solvers.smalbe import driver
from mortarbench.solvers.smalbe.compiled import Product

TOL = 1e-8
CELLS = (12, 24, 36, 48)  #: per side: 88, 376, 820 and 1468 discs
PERTURBED = np.linspace(0.97, 1.03, 10)  #: factors of the norm, or of the load
LARGE = (256, 512)  #: cells per side, P an operator
ROUNDS = 5  #: number of alternating rounds in the measurement of times
CONIC = ("clarabel", "scs", "qoco", "cvxopt", "ecos")
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


@contextmanager
def perturbed_norm(factor: float) -> Iterator[None]:
    """Multiply by `factor` the estimates of ‖P‖ for a first step."""

    def norm(name: str, estimate: Any, *args: Any, **keys: Any) -> Any:
        result = estimate(*args, **keys)
        power = -1 if name == "alpha" else 1
        return result._replace(**{name: getattr(result, name) * factor**power})

    with ExitStack() as stack:
        for module, function, name in (
            (driver, "by_lanczos", "norm"),
            (apgd, "_start", "L"),
            (projected_gradient, "_start", "alpha"),
        ):
            estimate = partial(norm, name, getattr(module, function))
            stack.enter_context(patch.object(module, function, estimate))
        yield


def ratios() -> None:
    """Print ratios of products over all Q/μP and ν, with norms and loads perturbed."""
    names = [name for name in METHODS if name != "nsgs"]
    for kind in ("norms", "loads"):
        spent = []
        for nu in (0.0, 0.3, 0.45):
            for n in CELLS:
                for Q in (0.1, 0.3, 0.5, 0.7, 0.9):
                    qp = mindlin(n, nu, Q, dense=False)
                    for factor in PERTURBED:
                        norm, load = (factor, 1) if kind == "norms" else (1, factor)
                        with perturbed_norm(norm):
                            loaded = replace(qp, q=load * qp.q)
                            spent.append([count(name, loaded) for name in names])
        logs = np.log(spent).reshape(-1, len(PERTURBED), len(names))
        means = zip(names, np.exp(logs.mean(axis=(0, 1))), strict=True)
        print(kind, "perturbed, geometric means of products:")
        print("  ", ", ".join(f"{name} {mean:.1f}" for name, mean in means))
        for over, values in (("problems", logs.mean(axis=1)), ("solves", logs)):
            ratio = np.exp(values[..., 0] - values[..., 1:].min(axis=-1))
            print(
                f"   smalbe to the best other method, {ratio.size} {over}: geometric "
                f"mean {np.exp(np.log(ratio).mean()):.2f}, largest {ratio.max():.2f}"
            )


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


def conic() -> None:
    """Print processor times to a point that is verified at 1e-8, ν = 0.3, Q/μP = 0.5.

    Each solver runs at 1e-6, 1e-8, … until its point is verified; the last run counts.
    """
    for n in CELLS[:3]:
        qp, cells = mindlin(n, 0.3, 0.5), []
        for name in ("smalbe", *CONIC):
            for tol in (1e-6, 1e-8, 1e-10, 1e-12):
                began = process_time()
                s = SOLVERS[name].prepare(qp, tol)()
                ms = 1e3 * (process_time() - began)
                answer = mb.verify(qp, s.x, y=s.y, z=s.z, z_box=s.z_box, tol=TOL)
                if answer.verdict.value == "verified":
                    cells.append(f"{name} {ms:.3g} ms ({tol:.0e})")
                    break
            else:
                cells.append(f"{name} not verified")
        print(qp.sets[1].radius.size, "discs:", ", ".join(cells))


if __name__ == "__main__":
    parser = ArgumentParser(description="Solvers on discs of friction.")
    parser.add_argument("table", choices=["products", "ratios", "time", "conic"])
    tables = {"products": products, "ratios": ratios, "time": time, "conic": conic}
    tables[parser.parse_args().table]()
