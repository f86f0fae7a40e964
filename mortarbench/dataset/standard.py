"""Standard data of the public set: of order one, and the same on every machine.

A QP of a family becomes one of the set in three steps:

* *Scaling*: x = 2ᵃx̂, f̂ = 2ᶜf, rows times 2ᵉ and 2ᵍ, so that f̂ and the largest entries
  of P̂ and of the rows are of order one. Powers of two scale without rounding.
* *Rounding* to integer multiples of a unit: 2⁻⁴⁰ times the largest entry of a vector or
  a matrix of rows, and 2⁻⁴⁰√(PᵢᵢPⱼⱼ) for Pᵢⱼ, up to factors of two. Rounding errors of
  BLAS are usually below one unit, but may exceed it, or change an entry between two
  units. For arrays that depend on BLAS, the last eight bits of the integers are stored;
  with these, errors of up to 127 units, a relative error of 1e-10, are corrected.
* *Shift*: if rounding has made a singular P slightly indefinite, 2⁻³⁰ of Pᵢᵢ (up to
  factors of two) is added to its diagonal.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csc_array, diags_array, eye_array, issparse, tril

from mortarbench.harness import QP
from mortarbench.harness.qp import Vector
from mortarbench.harness.sets.arrays import further_sets, set_arrays

BITS = 40  #: bits of the largest number of an array
LEAST_SIZE = 2.0**-10  #: least size of data of order one that defines a unit
SHIFT = 2.0**-30  #: multiple of the diagonal that is added to an indefinite P
#: Largest numbers of this fraction between powers of two change the unit. The fraction
#: is irrational, so that numbers such as 1, which may have rounding errors, are not at
#: the threshold.
_THRESHOLD = np.e - 2
_KEPT = 256  #: number of integers that the stored bits of an integer distinguish
Integers = NDArray[np.int64]
#: Exponents of the powers of two that scale a QP: a of x = 2ᵃx̂, c of f̂ = 2ᶜf, e of
#: Â = 2ᵃ⁺ᵉA and b̂ = 2ᵉb, g of Ĝ = 2ᵃ⁺ᵍG and ĥ = 2ᵍh
Scales = tuple[int, ...]


def scales_of(qp: QP, optimum: float) -> Scales:
    """Return scales with which f̂* and the largest entries are of order one.

    optimum : optimal value of the objective; 0 if there is none
    """
    c = -int(_exponent(optimum)) if optimum else 0
    largest = float(np.max(qp.P.diagonal(), initial=0.0)) or 1.0
    a = -round((int(_exponent(largest)) + c) / 2)
    rows = [float(abs(M).max()) if M.shape[0] else 1.0 for M in (qp.A, qp.G)]
    e, g = (-a - int(_exponent(row or 1.0)) for row in rows)
    return a, c, e, g


def scaled(qp: QP, scales: Scales) -> QP:
    """Return the QP in x̂, with sparse rows; entries are multiplied exactly."""
    a, c, e, g = (2.0**exponent for exponent in scales)
    T = a * eye_array(qp.q.size, format="csc")
    return QP(
        P=qp.P * (a * a * c),
        q=qp.q * (a * c),
        A=_without_noise(qp.A * (a * e)),
        b=qp.b * e,
        G=_without_noise(qp.G * (a * g)),
        h=qp.h * g,
        sets=[one.substituted(T, np.zeros(qp.q.size)) for one in qp.sets],
    )


def numbers(qp: QP) -> dict[str, tuple[Vector, Any]]:
    """Return the numbers of a QP with their units, keyed by the names of arrays.

    P, the last, is represented by its lower triangle. A unit is a number or an array.
    """
    P, e = _triangle(qp.P), np.maximum(curvature_exponents(qp.P), -BITS)
    vectors = {"q": qp.q, "b": qp.b, "h": qp.h, "A": qp.A.data, "G": qp.G.data}
    vectors |= _sizes(set_arrays(qp.sets[1:]))
    unit = _unit(np.concatenate([qp.lb, qp.ub]))
    return (
        {name: (vector, _unit(vector)) for name, vector in vectors.items()}
        | {"lb": (qp.lb, unit), "ub": (qp.ub, unit)}
        | {"P": (P.data, np.exp2(e[P.row] + e[P.col] - BITS))}
    )


def rounded(qp: QP, bits: NDArray[np.uint8], *, is_shifted: bool) -> QP:
    """Return the QP with integer multiples of units, and a shift of P if `is_shifted`.

    bits : result of `last_bits`, or empty to use the integers that are nearest
    """
    values, half, start = dict[str, Any](), _KEPT // 2, 0
    for name, (vector, unit) in numbers(qp).items():
        k = _integers(vector, unit)
        last = bits[start : start + k.size].astype(np.int64)
        start += k.size
        if last.size:
            k += (last - k + half) % _KEPT - half
        values[name] = np.where(np.isfinite(vector), k * unit, vector)
    P, e = _triangle(qp.P), curvature_exponents(qp.P)
    lower = coo_array((values["P"], P.coords), shape=P.shape)
    whole = csc_array(lower + tril(lower, -1).T)
    if is_shifted:
        whole = csc_array(whole + SHIFT * diags_array(np.exp2(2 * e) * (e > -np.inf)))
    values["P"] = whole if issparse(qp.P) else whole.toarray()
    for name, M in (("A", qp.A), ("G", qp.G)):
        values[name] = csc_array((values[name], M.indices, M.indptr), shape=M.shape)
    sets = further_sets(set_arrays(qp.sets[1:]) | _sizes(values))
    names = ("P", "q", "A", "b", "G", "h", "lb", "ub")
    return QP(**{name: values[name] for name in names}, sets=sets)


def last_bits(qp: QP) -> NDArray[np.uint8]:
    """Return the last eight bits of the integers of arrays that depend on BLAS.

    They are all but a stiffness matrix, which is assembled without BLAS.
    """
    pairs = numbers(qp)
    if issparse(qp.P):
        del pairs["P"]
    parts = [_integers(vector, unit) % _KEPT for vector, unit in pairs.values()]
    return np.concatenate(parts).astype(np.uint8)


def curvature_exponents(P: Any) -> Vector:
    """Return integers e (n,) with Pᵢᵢ ≈ 4ᵉ; −inf where Pᵢᵢ is not positive."""
    diagonal = P.diagonal()
    with np.errstate(divide="ignore"):
        e: Vector = np.floor(np.log2(np.maximum(diagonal, 0)) / 2 + _THRESHOLD)
    return e


def _without_noise(rows: Any) -> csc_array:
    """Return sparse rows without entries that would be rounded to zero."""
    M = csc_array(rows)
    kept = np.where(np.abs(M.data) > _unit(M.data), M.data, 0)
    M = csc_array((kept, M.indices.copy(), M.indptr.copy()), shape=M.shape)
    M.eliminate_zeros()
    return M


def _exponent(value: float) -> float:
    return float(np.floor(np.log2(abs(value)) + _THRESHOLD))


def _unit(vector: Vector) -> float:
    """Return a unit, which is limited: vectors of rounding errors become zero."""
    largest = float(np.abs(vector[np.isfinite(vector)]).max(initial=LEAST_SIZE))
    return float(2.0 ** (_exponent(largest) - BITS))


def _triangle(P: Any) -> coo_array:
    """Return the lower triangle of P; all entries of it if P is dense."""
    if issparse(P):
        return coo_array(tril((P + P.T) / 2))
    i, j = np.tril_indices(P.shape[0])
    return coo_array(((P[i, j] + P[j, i]) / 2, (i, j)), shape=P.shape)


def _sizes(values: Mapping[str, Vector]) -> dict[str, Vector]:
    """Return the sizes of discs and cones."""
    return {k: v for k, v in values.items() if k.endswith(("radius", "slope"))}


def _integers(vector: Vector, unit: Any) -> Integers:
    """Return the multiples of a unit nearest to the numbers; 0 for infinite ones."""
    finite = np.where(np.isfinite(vector), vector, 0)
    k: Integers = np.rint(finite / unit).astype(np.int64)
    return k
