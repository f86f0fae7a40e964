"""Items of the public set: their QPs, certificates, and lines of the catalogue."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.sparse import csc_array, diags_array

from mortarbench.case import as_case
from mortarbench.dataset.optimum import (
    UnprovenError,
    optimum_interval,
    tightened,
)
from mortarbench.dataset.standard import rounded, scaled
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
from mortarbench.registries import reference

Row = dict[str, str]  #: a line of the catalogue
#: vectors that prove the optimum, the infeasibility or the unboundedness of a QP
Certificate = Mapping[str, Vector]

HERE = Path(__file__).parent
CATALOGUE = "catalogue.csv"
BITS = "bits.npz"  #: last bits of numbers, see `last_bits`, by the name of the item
NO_BITS = np.zeros(0, dtype=np.uint8)
OPTIMAL, INFEASIBLE, UNBOUNDED = "optimal", "infeasible", "unbounded"
#: vectors of the certificates, by kind
VECTORS = {OPTIMAL: ("x", "y", "z"), INFEASIBLE: ("y", "z"), UNBOUNDED: ("x", "ray")}
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
    path, table = folder / CATALOGUE, pd.DataFrame()
    with suppress(OSError, ValueError):
        table = pd.read_csv(path, dtype=str, keep_default_na=False)
    columns = pd.read_csv(HERE / CATALOGUE, nrows=0).columns
    if table.empty or list(table) != list(columns):
        raise InputError(
            f"{path} is no catalogue of a folder of `dataset build`; expected the "
            f"columns {', '.join(columns)}"
        )
    rows: list[Row] = table.to_dict("records")
    return rows


def write_catalogue(folder: Path, rows: Sequence[Row]) -> None:
    """Write the lines of a catalogue."""
    pd.DataFrame(rows).to_csv(folder / CATALOGUE, index=False, lineterminator="\n")


cached_case = lru_cache(maxsize=2)(as_case)  #: function that builds a QP once


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
        last, bound = bound, mu * np.maximum(reference(found[-1]).x[normals], 0)
        if np.abs(bound - last).max() <= _SETTLED * np.abs(bound).max():
            break
    return tuple(found[1:])


def scaled_qp(row: Row) -> QP:
    """Return the QP of an item, scaled but not rounded."""
    scales = tuple(map(int, row["scales"].split()))
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
    ArithmeticError
        If there is none.

    """
    if kind == OPTIMAL:
        s = reference(tightened(qp))
        return {"x": s.x, "y": s.y, "z": s.z}
    if kind == INFEASIBLE and (least := least_violation(qp)) is not None:
        return {"y": least[1], "z": least[2]}
    for ray in steepest_ray(qp):  # a translation, with components 0 and 1
        ray = np.round(ray / np.abs(ray).max(), 6)
        return {"x": np.zeros(qp.q.size), "ray": ray}
    raise UnprovenError(f"no certificate that the QP is {kind}")


def objections(row: Row, qp: QP, proof: Certificate) -> Iterator[str]:
    """Yield what a certificate does not prove of a line of the catalogue.

    Raises
    ------
    UnprovenError
        If the certificate proves nothing, for the reason in the message.

    """
    shapes = {"x": qp.q, "ray": qp.q, "y": qp.b, "z": qp.h}
    for name in VECTORS[row["kind"]]:
        vector = proof.get(name, np.zeros(0))
        if vector.shape != shapes[name].shape or not np.isfinite(vector).all():
            yield f"its certificate has no finite vector {name} of the right size"
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
        optimum, bound = float(row["optimum"]), float(row["bound"])
        if not bound <= MAX_BOUND * max(1.0, abs(optimum)):
            yield f"its bound is {bound:g}; expected at most {MAX_BOUND:g} max(1, |f*|)"
        low, high = optimum_interval(qp, proof["x"], proof["y"], proof["z"])
        if not optimum - bound <= low <= high <= optimum + bound:
            yield f"f* = {optimum!r} is refuted: it is between {low!r} and {high!r}"
