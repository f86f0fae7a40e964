"""Convex quadratic programs, the input of all solvers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import prod
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array, csc_array, issparse

from mortarbench.harness.errors import InputError, shortened, shown
from mortarbench.harness.sets.blocks import Blocks
from mortarbench.harness.sets.box import Box
from mortarbench.harness.sets.convex import ConvexSet, hull, numeric_array
from mortarbench.harness.sets.convex import Vector as Vector
from mortarbench.harness.sets.discs import Discs

#: parts of a QP that are passed to `QP.from_arrays`, except sets
_PARTS = ("P", "q", "G", "h", "A", "b", "lb", "ub")
NEEDS_MATRICES = "needs explicit matrices"
Matrix = Any  #: (r, c) ndarray, csc_array, or (P only) LinearOperator
#: Largest absolute entry of P − Pᵀ that counts as rounding, relative to the largest
#: absolute entry of P.
SYMMETRY_TOLERANCE = 1e-12
#: Limits of at least this magnitude in arrays and files are infinite. Many programs
#: write 1e20 for infinity, some after rounding or scaling.
MIN_INFINITE = 1e20 * (1 - 1e-6)
#: Largest number of rows of P for which convexity is checked by a Cholesky
#: factorisation. For a P of this size, the factorisation takes less than a second.
_MAX_FACTORED_ROWS = 2000
#: Smallest permitted eigenvalue of the scaled P. The limit is negative, since entries
#: rounded to six digits, as in some text formats, may perturb zero eigenvalues.
_MIN_CURVATURE = -1e-6
#: Smallest diagonal entry used for scaling, relative to the largest entry of P. Smaller
#: entries may consist mostly of rounding errors.
_MIN_DIAGONAL = 1e-4


@dataclass(frozen=True, eq=False, kw_only=True)
class Structure:
    """The matrices K and B of a dual QP with P = B K⁺ Bᵀ, in the units of the QP."""

    K: Matrix  #: (N, N) sparse stiffness, positive semidefinite
    B: Matrix  #: (n, N) sparse constraint rows
    fixed: NDArray[np.int64]  #: (k,) components on which K⁺ is zero


@dataclass(frozen=True, eq=False, kw_only=True, init=False)
class QP:
    """A convex quadratic program.

    ::

        minimise    ½ xᵀP x + qᵀx
        subject to  A x = b          multiplier y
                    G x ≤ h          multiplier z ≥ 0
                    lb ≤ x ≤ ub      multiplier z_box, ≤ 0 at lb and ≥ 0 at ub

    so that at a solution  P x + q + Aᵀy + Gᵀz + z_box = 0  (qpsolvers' convention).
    Blocks of variables may also be restricted to convex sets; z_box is then an element
    of the normal cone of the set at x.

    Absent constraints have zero rows, and absent bounds are ±inf, never None. Sparse
    matrices of any format become ``scipy.sparse.csc_array``, without duplicate entries
    and with 32-bit indices if these suffice. Vectors and the entries of matrices become
    read-only, so that an exception occurs if a solver scales its input in place.
    `from_arrays` accepts more types of input and copies the arrays.

    Parameters
    ----------
    P, q, structure : see the attributes
    A, b, G, h : see the attributes; None for no constraints
    lb, ub : (n,) bounds, -inf and inf where absent; None for the bounds of the `Box` in
        `sets`, or for no bounds
    sets : convex sets of blocks of variables; the first may be a `Box` instead of lb
        and ub. Discs of a single variable are converted to bounds

    Raises
    ------
    ValueError
        If shapes disagree, bounds cross, a vector contains NaN (or inf, except in
        bounds), a set has an index that is out of range, or two sets share a variable.

    Examples
    --------
    Minimise x₁² + x₂² − 2x₁ subject to x₁ + x₂ = 1 and x ≥ 0:

    >>> import numpy as np
    >>> from mortarbench import QP
    >>> qp = QP.from_arrays(
    ...     2 * np.eye(2), [-2, 0], A=[1, 1], b=1, lb=0
    ... )
    >>> qp
    <QP: 2 variables, 1 equalities, 0 inequalities, 2 bounds>
    >>> qp.objective(np.array([1.0, 0.0]))
    -1.0

    """

    P: Matrix  #: (n, n) matrix of the quadratic term, symmetric positive semidefinite
    q: Vector  #: (n,) coefficients of the linear term
    A: Matrix  #: (m, n) matrix of the equality constraints
    b: Vector  #: (m,) right-hand sides of the equality constraints
    G: Matrix  #: (p, n) matrix of the inequality constraints
    h: Vector  #: (p,) right-hand sides of the inequality constraints
    sets: tuple[ConvexSet, ...]  #: the `Box` of lb and ub, followed by the other sets
    #: data that a solver may use but must not require
    structure: Structure | None = None

    def __init__(
        self,
        *,
        P: Matrix,
        q: Vector,
        A: Matrix | None = None,
        b: Vector | None = None,
        G: Matrix | None = None,
        h: Vector | None = None,
        lb: Vector | None = None,
        ub: Vector | None = None,
        sets: Sequence[ConvexSet] = (),
        structure: Structure | None = None,
    ) -> None:
        further = tuple(sets)
        has_box = bool(further) and isinstance(further[0], Box)
        box = further[0] if has_box else Box.unbounded(q.size)
        assert isinstance(box, Box)
        if lb is not None or ub is not None:
            box = Box(box.lower if lb is None else lb, box.upper if ub is None else ub)
        n = q.size
        b, h = (np.zeros(0) if v is None else v for v in (b, h))
        P, A, G = (_by_columns(no_rows(n) if M is None else M) for M in (P, A, G))
        arrays = {"P": P, "q": q, "A": A, "b": b, "G": G, "h": h}
        m, p = b.size, h.size
        shapes = ((n, n), (n,), (m, n), (m,), (p, n), (p,))
        for (name, array), shape in zip(arrays.items(), shapes, strict=True):
            if array.shape != shape:
                raise ValueError(f"QP.{name} has shape {array.shape}, expected {shape}")
        for name in ("q", "b", "h"):
            _check_finite(name, arrays[name])
        every = _without_intervals((box, *further[has_box:]), n)
        values = {**arrays, "sets": every, "structure": structure}
        for name, value in values.items():
            object.__setattr__(self, name, value)
        set_arrays = [array for one in every for array in one.arrays().values()]
        for array in (*arrays.values(), *set_arrays):
            _freeze(array)

    @property
    def box(self) -> Box:
        """The bounds as a set, `sets[0]`."""
        box = self.sets[0]
        assert isinstance(box, Box)
        return box

    @property
    def lb(self) -> Vector:
        """Lower bounds (n,), -inf where absent."""
        return self.box.lower

    @property
    def ub(self) -> Vector:
        """Upper bounds (n,), inf where absent."""
        return self.box.upper

    @classmethod
    def from_arrays(
        cls,
        P: ArrayLike | Matrix,
        q: ArrayLike,
        G: ArrayLike | Matrix | None = None,
        h: ArrayLike | None = None,
        A: ArrayLike | Matrix | None = None,
        b: ArrayLike | None = None,
        lb: ArrayLike | None = None,
        ub: ArrayLike | None = None,
        sets: Sequence[ConvexSet] = (),
    ) -> QP:
        """Create a QP from copies of arrays, after checking them.

        Matrices may be dense or sparse; sparse matrices are stored by columns. A vector
        may also be a matrix with one row or column. A single row of G or A may be a
        vector, with a scalar right-hand side. If all lower or all upper bounds are
        equal, a scalar suffices. Absent constraints and bounds are None. Limits of at
        least 1e20·(1 − 1e-6) are infinite; rows of G with an infinite h are dropped.

        Parameters
        ----------
        P : (n, n) symmetric positive semidefinite, with both triangles
        q : (n,)
        G, h : (p, n) and (p,), the rows G x ≤ h; h is inf where a row has no limit
        A, b : (m, n) and (m,), the rows A x = b
        lb, ub : (n,) bounds, -inf and inf where absent
        sets : convex sets of blocks of variables without bounds

        Raises
        ------
        InputError
            If an argument is missing, is not numeric, has the wrong shape or contains
            NaN (or inf, except in bounds and h), if `sets` is not a tuple or list of
            valid convex sets other than `Box`, if bounds cross, or if P is not
            symmetric or not positive semidefinite (see `check_convex`).

        Examples
        --------
        >>> from mortarbench import QP
        >>> qp = QP.from_arrays([[2, 0], [0, 1]], [-1, -1], G=[[1, 1]], h=[1], lb=0)
        >>> qp.sizes
        {'variables': 2, 'equalities': 0, 'inequalities': 1, 'bounds': 2}
        >>> QP.from_arrays([[1, 2], [0, 1]], [0, 0])
        Traceback (most recent call last):
            ...
        mortarbench.harness.errors.InputError: P is not symmetric: ...

        """
        if not isinstance(sets, tuple | list) or not all(
            isinstance(one, ConvexSet) and not isinstance(one, Box) for one in sets
        ):
            raise InputError(
                f"sets = {shown(sets)}; expected a tuple of convex sets in addition "
                "to lb and ub for bounds"
            )
        for M, rhs, name, side in ((G, h, "G", "h"), (A, b, "A", "b")):
            if (M is None) != (rhs is None):
                here, absent = (name, side) if rhs is None else (side, name)
                raise InputError(f"{absent} is missing, but {here} is present")
        vector = numeric_vector("q", q)
        if not (n := vector.size):
            raise InputError("q is empty; expected at least one variable")
        try:
            hessian = _matrix("P", P, n, n)
            rows, limits = _rows("G", G, "h", h, n)
            limits = with_infinities(limits)
            kept = limits != np.inf
            equalities, sides = _rows("A", A, "b", b, n)
            # rows are numbered before those without a limit are dropped
            _check_finite("h", np.where(kept, limits, 0.0))
            qp = cls(
                P=hessian,
                q=vector,
                A=equalities,
                b=sides,
                G=rows if kept.all() else rows[kept],
                h=limits[kept],
                lb=_bound("lb", lb, -np.inf, n),
                ub=_bound("ub", ub, np.inf, n),
                sets=sets,
            )
            check_symmetric(qp.P)
        except ValueError as e:
            raise InputError(str(e)) from None
        check_convex(qp.P)
        return qp

    @classmethod
    def from_qpsolvers(cls, problem: Any) -> QP:
        """Create a QP from a ``qpsolvers.Problem``, whose conventions are the same.

        Raises
        ------
        InputError
            For the same reasons as in `from_arrays`.

        """
        return cls.from_arrays(**{name: getattr(problem, name) for name in _PARTS})

    @classmethod
    def from_cvxpy(cls, problem: Any) -> QP:
        """Create the QP to which cvxpy compiles a ``cvxpy.Problem``.

        Its variables are those of the compiled problem, including auxiliary ones.
        Constants of the objective are dropped, and a maximised objective is negated.

        Raises
        ------
        InputError
            If cvxpy cannot compile the problem to a QP, for instance because of
            integer variables, second-order cones or parameters without values.

        """
        for parameter in problem.parameters():
            if parameter.value is None:
                raise InputError(
                    f"the parameter {parameter.name()} of cvxpy has no value; expected "
                    "values of all parameters"
                )
        try:  # cvxpy depends on OSQP, so this form of the data is always available
            data, _, _ = problem.get_problem_data("OSQP")
        except Exception as e:  # the errors of cvxpy have no common base class
            why = shortened(" ".join(str(e).split())).rstrip(".")
            raise InputError(
                f"cvxpy cannot compile the problem to a QP: {why}; expected a convex "
                "quadratic objective and linear constraints of continuous variables"
            ) from None
        G, h = data["F"], data["G"]
        return cls.from_arrays(data["P"], data["q"], G, h, data["A"], data["b"])

    def __repr__(self) -> str:
        sizes = ", ".join(f"{count} {name}" for name, count in self.sizes.items())
        return f"<QP: {sizes}>"

    @property
    def is_explicit(self) -> bool:
        """True if P is a dense or sparse matrix, False for an operator."""
        return isinstance(self.P, np.ndarray) or issparse(self.P)

    def diagonal(self) -> Vector | None:
        """Return the diagonal of P (n,); None if an operator P does not provide it."""
        if self.is_explicit:
            return np.asarray(self.P.diagonal(), dtype=float)
        if not hasattr(self.P, "diagonal"):
            return None
        diagonal: Vector | None = self.P.diagonal()
        return diagonal

    @property
    def sizes(self) -> dict[str, int]:
        """Numbers of variables, equality rows, inequality rows and finite bounds.

        If the QP has discs or cones, the result also contains their numbers.
        """
        bounds = np.isfinite(self.lb).sum() + np.isfinite(self.ub).sum()
        sizes = {
            "variables": self.q.size,
            "equalities": self.b.size,
            "inequalities": self.h.size,
            "bounds": int(bounds),
        }
        for one in self.sets[1:]:
            if isinstance(one, Blocks):
                kind = type(one).__name__.lower()
                sizes[kind] = sizes.get(kind, 0) + len(one.index)
        return sizes

    def with_bounds(self, lb: Vector, ub: Vector) -> QP:
        """Return a copy of the QP with the given bounds (n,)."""
        return replace(self, sets=(Box(lb, ub), *self.sets[1:]))

    def objective(self, x: Vector) -> float:
        """Evaluate ½ xᵀP x + qᵀx."""
        return float(0.5 * x @ (self.P @ x) + self.q @ x)


def with_infinities(limits: Vector) -> Vector:
    """Replace limits of at least `MIN_INFINITE` by ±inf.

    >>> import numpy as np
    >>> from mortarbench.harness.qp import with_infinities
    >>> with_infinities(np.array([1e19, -9.99999999e19]))
    array([1.e+19,   -inf])
    """
    is_finite = ~(np.abs(limits) >= MIN_INFINITE)
    return np.where(is_finite, limits, np.copysign(np.inf, limits))


def _check_finite(name: str, v: Vector) -> None:
    """Raise ValueError if a vector contains NaN or inf."""
    if not np.isfinite(v).all():
        values = np.asarray(v)
        i = int(np.isfinite(values).argmin())
        raise ValueError(f"{name}[{i}] is {values[i]:g}; expected a finite number")


def _without_intervals(sets: Sequence[ConvexSet], n: int) -> tuple[ConvexSet, ...]:
    """Check the sets, and convert discs of one variable to bounds.

    Sets without variables are omitted.

    Raises
    ------
    ValueError
        If a set does not fit n variables, or two sets share a variable.

    """
    _check_sets(sets, n)
    box, others = sets[0], list[ConvexSet]()
    for one in sets[1:]:
        if isinstance(one, Discs) and one.index.shape[1] == 1:
            box = Box(*hull((box, one), n))
        elif one.block.size:
            others.append(one)
    return box, *others


def _check_sets(sets: Sequence[ConvexSet], n: int) -> None:
    """Raise ValueError if a set does not fit n variables, or if two sets overlap."""
    taken = np.zeros(n, dtype=bool)
    for one in sets:
        one.check(n)
        if len(sets) == 1:
            return
        shared = one.block[taken[one.block]]
        if shared.size:
            raise ValueError(
                f"QP.sets: variable {shared[0]} is in two sets, or in a set and has "
                "bounds; expected disjoint blocks of unbounded variables"
            )
        taken[one.block] = True


def no_rows(n: int) -> Matrix:
    """Return a sparse (0, n) matrix, which stands for absent constraints."""
    return csc_array((0, n))


def needs_matrices(qp: QP) -> str | None:
    """Return the reason to decline a `qp` whose P is an operator, or None.

    A solver that reads entries of P should call this function in `declines`. If a
    solver declines for this reason and P is small, the matrix is assembled while the
    clock runs. Then `declines` is called again.

    Examples
    --------
    >>> import numpy as np
    >>> from mortarbench import QP
    >>> from mortarbench.harness import needs_matrices
    >>> needs_matrices(QP.from_arrays(np.eye(2), [0, 0])) is None
    True

    """
    return None if qp.is_explicit else NEEDS_MATRICES


def check_symmetric(P: Matrix) -> None:
    """Check that P is symmetric up to rounding.

    If P were asymmetric, solvers that read only the upper or only the lower triangle
    would solve different problems.

    Raises
    ------
    ValueError
        If P is not symmetric. The message states the two entries with the largest
        difference.

    """
    difference = coo_array(abs(P - P.T))
    largest = abs(P).max() if prod(P.shape) else 0.0
    if difference.nnz and difference.data.max() > SYMMETRY_TOLERANCE * largest:
        k = int(difference.data.argmax())
        i, j = (int(index[k]) for index in difference.coords)
        raise ValueError(
            f"P is not symmetric: P[{i}, {j}] and P[{j}, {i}] differ by "
            f"{difference.data[k]:.3g}; expected both triangles: P + P.T - "
            "diag(diag(P)) for a triangular P"
        )


def check_convex(P: Matrix) -> None:
    """Check that P is positive semidefinite up to rounding.

    If P had a direction of negative curvature, a KKT point could be a saddle point or a
    maximum. Let D be the diagonal matrix with entries dᵢ = max(Pᵢᵢ, 1e-4 max|P|). The
    eigenvalues of D⁻½PD⁻½ must exceed −1e-6, that is, D⁻½PD⁻½ + 1e-6·I must have a
    Cholesky factor. Eigenvalues between −1e-6 and 0 may be due to rounding. If P has
    more than 2000 rows, only its diagonal is checked.

    Raises
    ------
    InputError
        If a diagonal entry of P is below −1e-10 max|P|, or, up to 2000 rows, if
        D⁻½PD⁻½ has an eigenvalue of at most −1e-6.

    """
    largest = float(abs(P).max()) if P.shape[0] else 0.0
    if not largest:
        return
    diagonal = P.diagonal() / largest
    i = int(diagonal.argmin())
    if diagonal[i] < _MIN_CURVATURE * _MIN_DIAGONAL:
        raise InputError(
            f"P is not positive semidefinite: P[{i}, {i}] = {P.diagonal()[i]:.3g}; "
            "expected a convex QP"
        )
    if P.shape[0] > _MAX_FACTORED_ROWS:
        return
    root = np.sqrt(np.maximum(diagonal, _MIN_DIAGONAL))
    scaled = (P.toarray() if issparse(P) else P) / largest / root / root[:, None]
    try:
        np.linalg.cholesky(scaled - _MIN_CURVATURE * np.eye(len(root)))
    except np.linalg.LinAlgError:
        raise InputError(
            "P is not positive semidefinite: it has a negative eigenvalue; expected a "
            "convex QP"
        ) from None


def canonical(M: Matrix) -> Matrix:
    """Return a sparse matrix with sorted indices and without duplicate entries.

    Indices must be sorted before arrays become read-only, since SciPy sorts in place.
    """
    if M.has_canonical_format:
        return M
    M = M.copy()
    M.sum_duplicates()
    return M


def numeric_vector(name: str, value: Any, n: int | None = None) -> Vector:
    """Return a copy of a vector, which may also be a matrix with one row or column.

    A vector of MATLAB without entries is a matrix without entries.

    name : name of the vector in messages
    n : expected number of entries; None for any number

    Raises
    ------
    InputError
        If `value` is not numeric or has the wrong shape; NaN and inf are accepted.

    """
    array = numeric_array(name, value)
    is_flat = array.ndim == 2 and (1 in array.shape or not array.size)
    vector = array.ravel() if is_flat else array
    if vector.ndim != 1 or (n is not None and vector.size != n):
        expected = "one dimension" if n is None else f"({n},)"
        raise InputError(f"{name} has shape {array.shape}; expected {expected}")
    return vector


def _bound(name: str, value: ArrayLike | None, absent: float, n: int) -> Vector:
    """Return a vector of bounds (n,); a scalar applies to all variables.

    absent : value of all entries if `value` is None
    """
    value = absent if value is None else value
    if np.ndim(value) == 0 and not issparse(value):
        return with_infinities(np.full(n, numeric_array(name, value)))
    return with_infinities(numeric_vector(name, value, n))


def _matrix(name: str, value: Any, rows: int | None, n: int) -> Matrix:
    """Check that `value` is a finite matrix with n columns, and return a copy.

    rows : expected number of rows; None for any number
    """
    if issparse(value):
        if value.dtype.kind not in "biuf":
            raise InputError(
                f"{name} is of type {value.dtype}; expected an array of numbers"
            )
        value = csc_array(value) if value.ndim == 2 else value.toarray()
    if issparse(value):
        M = canonical(csc_array(value, dtype=float, copy=True))
        entries = M.data
    else:
        if not isinstance(value, np.ndarray) and hasattr(value, "matvec"):
            raise InputError(
                f"{name} is an operator; expected a matrix: {name} @ np.eye({n})"
            )
        M = entries = numeric_array(name, value)
        M = np.atleast_2d(M) if rows is None else M
    if not np.isfinite(entries).all():
        where = coo_array(M)
        k = int(np.isfinite(where.data).argmin())
        place = ", ".join(str(int(index[k])) for index in where.coords)
        raise InputError(
            f"{name}[{place}] is {where.data[k]:g}; expected a finite number"
        )
    if M.ndim != 2 or M.shape != (M.shape[0] if rows is None else rows, n):
        expected = f"({'rows' if rows is None else rows}, {n})"
        raise InputError(f"{name} has shape {M.shape}; expected {expected}")
    return M


def _rows(
    name: str, M: Any, side: str, rhs: ArrayLike | None, n: int
) -> tuple[Matrix, Vector]:
    """Return the matrix and the right-hand side of constraints.

    name, side : names of the matrix and the right-hand side, such as "G" and "h"
    M : matrix with n columns; None for zero rows
    """
    if M is None:
        return no_rows(n), np.zeros(0)
    matrix = _matrix(name, M, None, n)
    p = matrix.shape[0]
    scalar = rhs is not None and np.ndim(rhs) == 0 and not issparse(rhs)
    vector = numeric_vector(side, [rhs] if scalar else rhs)
    if vector.size != p:
        raise InputError(
            f"{side} has {vector.size} entries; expected {p}, one per row of {name}"
        )
    return matrix, vector


def _by_columns(M: Matrix) -> Matrix:
    """Return a sparse matrix as a `csc_array`, see `QP`; return others unchanged."""
    if not issparse(M):
        return M
    M = canonical(M if isinstance(M, csc_array) else csc_array(M))
    if M.indices.dtype != np.int32 and max(M.nnz, *M.shape) < 2**31:
        narrow = (M.indices.astype(np.int32), M.indptr.astype(np.int32))
        M = csc_array((M.data, *narrow), shape=M.shape)
    return M


def _freeze(M: Matrix) -> None:
    """Mark the entries of a dense or sparse matrix as read-only."""
    buffers = [M] if isinstance(M, np.ndarray) else [getattr(M, "data", None)]
    for buffer in buffers:
        if isinstance(buffer, np.ndarray):
            buffer.flags.writeable = False
