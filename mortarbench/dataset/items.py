"""Items of the public set: their QPs, certificates, and lines of the catalogue."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, diags_array

from mortarbench.case import Case, as_case
from mortarbench.dataset.optimum import (
    UnprovenError,
    optimum_interval,
    tightened,
)
from mortarbench.dataset.standard import Scales, rounded, scaled
from mortarbench.harness import QP, InputError
from mortarbench.harness.operators import assembled
from mortarbench.harness.qp import Vector
from mortarbench.harness.verify.infeasibility import (
    MIN_MARGIN,
    farkas_margin,
    is_ray,
    least_violation,
    steepest_ray,
)
from mortarbench.registries import Registries

Row = dict[str, str]  #: a line of the catalogue
#: vectors that prove the optimum, the infeasibility or the unboundedness of a QP
Certificate = Mapping[str, Vector]

HERE = Path(__file__).parent
CATALOGUE = "catalogue.csv"
BITS = "bits.npz"  #: last bits of numbers, see `last_bits`, by the name of the item
NO_BITS = np.zeros(0, dtype=np.uint8)
COLUMNS = (
    "name", "path", "digest", "core", "family", "sequence", "step", "kind",
    "dense", "strictly_convex", "discs", "n", "equalities", "inequalities", "bounds",
    "nnz", "condition", "rank", "active_share", "degeneracy", "optimum", "bound",
    "scales", "shifted", "energy_scale", "energy_constant", "units",
    "licence", "case", "change", "provenance",
)  # fmt: skip
OPTIMAL, INFEASIBLE, UNBOUNDED = "optimal", "infeasible", "unbounded"
REVERSED = "loads reversed"
ITERATION = "bounds of Coulomb iteration "
#: largest bound of the error of an optimum, relative to max(1, |f*|)
MAX_BOUND = 1e-8
_FARKAS_TOL = 1e-8  #: no point within 1/tol times the largest length is feasible
_MAX_ITERATIONS = 12  #: largest number of steps of Coulomb's iteration
_SETTLED = 1e-7  #: relative change of Coulomb's bounds that ends an iteration


def catalogue(folder: Path = HERE) -> list[Row]:
    """Return the lines of the catalogue of a set, by default the published one.

    Raises
    ------
    InputError
        If the folder has no catalogue, or the catalogue lacks a column.

    """
    path = folder / CATALOGUE
    if not path.is_file():
        raise InputError(
            f"{folder}: no {CATALOGUE}; expected a folder of `dataset build`"
        )
    rows: list[Row] = []
    with (
        suppress(ValueError, csv.Error),
        path.open(encoding="utf-8", newline="") as file,
    ):
        rows = list(csv.DictReader(file, strict=True))
    if not rows or any(tuple(row) != COLUMNS or None in row.values() for row in rows):
        raise InputError(f"{path}: expected the columns {', '.join(COLUMNS)}")
    return rows


def write_catalogue(folder: Path, rows: list[Row]) -> None:
    """Write the lines of a catalogue."""
    with (folder / CATALOGUE).open("w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


@lru_cache(maxsize=2)
def cached_case(name: str) -> Case:
    """Return a case, which builds its QP once."""
    return as_case(name)


def original(case: str, change: str) -> QP:
    """Return the QP of a case with a change, before scaling and rounding."""
    if change.startswith(ITERATION):
        return iterations(case)[int(change.removeprefix(ITERATION)) - 1]
    qp = cached_case(case).family_case.qp
    P = qp.P if qp.is_explicit else assembled(qp.P)
    sign = -1 if change == REVERSED else 1
    return QP(P=P, q=sign * qp.q, A=qp.A, b=sign * qp.b, G=qp.G, h=qp.h, sets=qp.sets)


@lru_cache(maxsize=1)
def iterations(name: str) -> tuple[QP, ...]:
    """Return the QPs of Coulomb's iteration, whose bounds are μ times the last forces.

    The first bound is twice the largest, everywhere. The tangential forces, which have
    two bounds, follow the normal forces, in the same order.
    """
    qp, mu = original(name, ""), float(cached_case(name).params["mu"])
    tangents = np.flatnonzero(np.isfinite(qp.lb) & np.isfinite(qp.ub))
    normals, found = tangents - tangents.size, [qp]
    bound = np.full(tangents.size, 2 * qp.ub[tangents].max())
    for _ in range(_MAX_ITERATIONS):
        lb, ub = qp.lb.copy(), qp.ub.copy()
        lb[tangents], ub[tangents] = -bound, bound
        found.append(qp.with_bounds(lb, ub))
        last, bound = bound, mu * np.maximum(_solved(found[-1]).x[normals], 0)
        if np.abs(bound - last).max() <= _SETTLED * np.abs(bound).max():
            break
    return tuple(found[1:])


def _solved(qp: QP) -> Any:
    return Registries().reference(qp)


def scaled_qp(row: Row) -> QP:
    """Return the QP of an item, scaled but not rounded."""
    scales = Scales(*map(int, row["scales"].split()))
    return scaled(original(row["case"], row["change"]), scales)


def standard_qp(row: Row, bits: NDArray[np.uint8] = NO_BITS) -> QP:
    """Return the QP of an item, scaled and rounded.

    bits : stored bits of this item, see `last_bits`
    """
    qp = rounded(scaled_qp(row), bits, is_shifted=row["shifted"] == "yes")
    if row["kind"] == UNBOUNDED:  # rounding must not bend P along the translation
        return replace(qp, P=csc_array(qp.P - diags_array(qp.P.sum(axis=1))))
    return qp


def certificate(kind: str, qp: QP) -> Certificate:
    """Compute a certificate; its vectors depend on BLAS, but not what they prove.

    Raises
    ------
    UnprovenError
        If there is none.

    """
    try:
        if kind == OPTIMAL:
            s = _solved(tightened(qp))
            return {"x": s.x, "y": s.y, "z": s.z}
        if kind == INFEASIBLE and (least := least_violation(qp)) is not None:
            return {"y": least[1], "z": least[2]}
        for ray in steepest_ray(qp):  # a translation, with components 0 and 1
            ray = np.round(ray / np.abs(ray).max(), 6)
            return {"x": np.zeros(qp.q.size), "ray": ray}
    except (ArithmeticError, ValueError) as e:
        raise UnprovenError(str(e)) from None
    raise UnprovenError(f"no certificate that the QP is {kind}")


def objections(row: Row, qp: QP, proof: Certificate) -> Iterator[str]:
    """Yield what a certificate does not prove of a line of the catalogue."""
    shapes = {"x": qp.q, "ray": qp.q, "y": qp.b, "z": qp.h}
    needed = {OPTIMAL: "xyz", INFEASIBLE: "yz", UNBOUNDED: ("x", "ray")}
    for name in needed[row["kind"]]:
        if name not in proof or proof[name].shape != shapes[name].shape:
            yield f"its certificate has no vector {name} of the right size"
            return
        if not np.isfinite(proof[name]).all():
            yield f"{name} of its certificate contains NaN or inf"
            return
    if row["kind"] == INFEASIBLE:
        if not farkas_margin(qp, proof["y"], proof["z"], _FARKAS_TOL) > MIN_MARGIN:
            yield "its certificate does not prove that the QP is infeasible"
    elif row["kind"] == UNBOUNDED:
        x, ray = proof["x"], proof["ray"]
        feasible = (qp.A @ x == qp.b).all() and (qp.G @ x <= qp.h).all()
        feasible &= all((one.project(x) == x).all() for one in qp.sets)
        if not (feasible and is_ray(qp, ray) and not (qp.P @ ray).any()):
            yield "its certificate does not prove that the QP is unbounded"
    else:
        yield from _wrong_optimum(row, qp, proof)


def _wrong_optimum(row: Row, qp: QP, proof: Certificate) -> Iterator[str]:
    optimum, bound = float(row["optimum"]), float(row["bound"])
    if not bound <= MAX_BOUND * max(1.0, abs(optimum)):
        yield f"its bound is {bound:g}; expected at most {MAX_BOUND:g} max(1, |f*|)"
    try:
        low, high = optimum_interval(qp, proof["x"], proof["y"], proof["z"])
    except UnprovenError as e:
        yield f"its certificate proves nothing: {e}"
        return
    if not high - low <= 2 * bound:
        yield f"its certificate proves f* only to {high - low:.1e}; expected {bound:g}"
    elif not optimum - bound <= low <= high <= optimum + bound:
        yield f"f* = {optimum!r} is refuted: it is between {low!r} and {high!r}"
