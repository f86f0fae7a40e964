"""Conversion between QPs and the forms of solver libraries: matrices and multipliers.

Libraries take a QP in one of two forms, for which multipliers are converted back:
`two_sided`, low ≤ Rx ≤ high, and `one_sided`, Rx = r (first rows) and Rx ≤ r.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_matrix, eye_array, vstack

from mortarbench.harness import QP, Matrix, Solution, Vector, needs_matrices, too_large
from mortarbench.harness.sets.convex import admissible
from mortarbench.harness.sets.discs import Discs

#: absolute tolerance for solvers whose test is ≤ absolute + relative·size, so that the
#: relative one decides
NEGLIGIBLE = 1e-14
#: ‖x‖∞ of a claimed solution beyond which it counts as diverged: the terms of the
#: residuals then are so large that every relative residual is small
DIVERGED = 1e12
#: ‖q‖∞ for solvers that compare with max(1, size): with sizes of about 1e4 the 1 has no
#: effect, and their tests are relative as those of the harness
OBJECTIVE_SIZE = 1e4


def needs_dense(qp: QP, copies: float) -> str | None:
    """Return the reason to decline a `qp` whose dense matrices do not fit, or None.

    copies : number of dense matrices of the size of P that the solver stores at once
    """
    return needs_matrices(qp) or too_large(qp.q.size, copies)


def needs_independent_rows(qp: QP) -> str | None:
    """Return the reason to decline a `qp` with dependent equality rows, or None."""
    # the singular values of AAᵀ are those of A squared, so rows that are dependent to
    # half of the digits count as dependent
    gram = dense(csc(qp.A) @ csc(qp.A).T)
    if not gram.size or np.linalg.matrix_rank(gram, hermitian=True) == len(gram):
        return None
    return "the equality rows depend on each other"


def csc(M: Matrix) -> csc_matrix:
    """Return a writable csc_matrix copy with sorted indices and no duplicates.

    It is not a csc_array: OSQP warns about these and qpsolvers takes them for dense.
    """
    copy = csc_matrix(M, dtype=np.float64, copy=True)
    copy.sum_duplicates()
    return copy


def dense(M: Matrix) -> Vector:
    """Return a dense copy of a dense or sparse matrix."""
    return np.array(M.toarray() if hasattr(M, "toarray") else M, dtype=np.float64)


def resolve_backend(backend: str, qp: QP) -> str:
    """Return `backend`, or for "auto" the storage of P: "dense" or "sparse"."""
    if backend != "auto":
        return backend
    return "dense" if isinstance(qp.P, np.ndarray) else "sparse"


def has_bound(qp: QP) -> NDArray[np.bool_]:
    """Return the mask (n,) of variables with a finite bound."""
    return np.isfinite(qp.lb) | np.isfinite(qp.ub)


def two_sided(qp: QP) -> tuple[csc_matrix, Vector, Vector]:
    """Return R, low, high of low ≤ Rx ≤ high: rows of A, of G, of bounded variables."""
    box = has_bound(qp)
    rows = vstack([csc(qp.A), csc(qp.G), eye_array(qp.q.size, format="csr")[box]])
    low = np.concatenate([qp.b, np.full(qp.h.size, -np.inf), qp.lb[box]])
    return csc(rows), low, np.concatenate([qp.b, qp.h, qp.ub[box]])


def from_two_sided(qp: QP, v: Vector) -> dict[str, Any]:
    """Return y, z and z_box for multipliers of `two_sided` rows, ≥ 0 at `high`."""
    m, p = qp.b.size, qp.h.size
    z_box = np.zeros(qp.q.size)
    z_box[has_bound(qp)] = v[m + p :]
    return {
        "y": np.array(v[:m]),
        "z": np.array(v[m : m + p]),
        "z_box": on_present_bounds(qp, z_box),
    }


def to_two_sided(qp: QP, s: Solution) -> Vector:
    """Return the multipliers of `two_sided` rows; the inverse of `from_two_sided`."""
    return np.concatenate([s.y, s.z, s.z_box[has_bound(qp)]])


def one_sided(qp: QP) -> tuple[csc_matrix, Vector]:
    """Return R, r of Rx = r for rows of A, Rx ≤ r for those of G, x ≤ ub, −x ≤ −lb."""
    up, low = np.isfinite(qp.ub), np.isfinite(qp.lb)
    eye = eye_array(qp.q.size, format="csr")
    rows = vstack([csc(qp.A), csc(qp.G), eye[up], -eye[low]])
    return csc(rows), np.concatenate([qp.b, qp.h, qp.ub[up], -qp.lb[low]])


def from_one_sided(qp: QP, v: Vector) -> dict[str, Any]:
    """Return y, z and z_box for multipliers of `one_sided` rows."""
    m, p = qp.b.size, qp.h.size
    up, low = np.isfinite(qp.ub), np.isfinite(qp.lb)
    z_up, z_low = np.split(v[m + p :], [up.sum()])
    z_box = np.zeros(qp.q.size)
    z_box[up] += z_up
    z_box[low] -= z_low
    return {
        "y": np.array(v[:m]),
        "z": np.array(v[m : m + p]),
        "z_box": on_present_bounds(qp, z_box),
    }


def conic(qp: QP) -> tuple[csc_matrix, Vector]:
    """Give Rx + s = r, s = (r_i, x_I) in a second-order cone for each disc."""
    eye = eye_array(qp.q.size, format="csr")
    rows, rhs = [csc(eye[:0])], [np.zeros(0)]
    for discs in qp.sets[1:]:
        assert isinstance(discs, Discs)
        for block, r in zip(discs.index, discs.radius, strict=True):
            rows += [csc(0 * eye[:1]), csc(-eye[block])]
            rhs += [np.append(r, np.zeros(block.size))]
    return csc(vstack(rows)), np.concatenate(rhs)


def from_conic(qp: QP, v: Vector) -> Vector:
    """Return z_box (n,) on discs from the duals of `conic`: (t, w) ↦ −w."""
    z_box, at = np.zeros(qp.q.size), 0
    for discs in qp.sets[1:]:
        assert isinstance(discs, Discs)
        for block in discs.index:
            z_box[block] = -v[at + 1 : at + 1 + block.size]
            at += 1 + block.size
    return z_box


def to_one_sided(qp: QP, s: Solution) -> Vector:
    """Return the multipliers of `one_sided` rows; the inverse of `from_one_sided`."""
    up, low = np.isfinite(qp.ub), np.isfinite(qp.lb)
    z_up, z_low = np.maximum(s.z_box[up], 0), np.maximum(-s.z_box[low], 0)
    return np.concatenate([s.y, s.z, z_up, z_low])


def conic_point(qp: QP, s: Solution) -> tuple[Vector, Vector, Vector]:
    """Return x, the multipliers and the slack max(r − Rx, 0) of `one_sided` rows."""
    rows, rhs = one_sided(qp)
    return s.x.copy(), to_one_sided(qp, s), np.maximum(rhs - rows @ s.x, 0.0)


def objective_factor(qp: QP, size: float = OBJECTIVE_SIZE) -> float:
    """Return the factor of the objective that makes ‖q‖∞ = `size`; 1 if q = 0."""
    return float(size / (np.abs(qp.q).max(initial=0.0) or size))


def on_present_bounds(qp: QP, z_box: Vector) -> Vector:
    """Return z_box (n,) with zeros for multipliers of absent bounds.

    Solvers leave rounding there. If it is more than rounding, the harness sees it as a
    residual of stationarity.
    """
    return admissible(qp.sets, z_box)


def check_choice(name: str, value: Any, allowed: tuple[Any, ...]) -> None:
    """Raise ValueError unless the value of the option `name` is among `allowed`."""
    if value not in allowed:
        choices = ", ".join(map(repr, allowed[:-1]))
        raise ValueError(f"{name} = {value!r}; expected {choices} or {allowed[-1]!r}")


def check_positive(**options: float) -> None:
    """Raise ValueError unless all options are positive and finite."""
    for name, value in options.items():
        if not 0 < value < np.inf:
            raise ValueError(f"{name} = {value}; expected a finite positive number")
