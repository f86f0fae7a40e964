"""The format of QPLIB, for convex QPs with linear constraints.

The lines of a file contain, in this order, the name, the type, the sense, and the
numbers of the sections that the type requires. A section of a vector consists of a
default value, the number of other entries, and these entries; indices start at 1. Text
after the fields of a line is a comment, and so are lines that begin with !, % or #.

The type has three letters: objective (L, D, C; Q may be nonconvex), variables (C:
continuous) and constraints (N, B: bounds only; L: linear). The objective is
½xᵀQ⁰x + b⁰ᵀx + q⁰; the lower triangle of Q⁰ is stored. Starting points and names, at
the end of the file, are ignored.

Reference: F. Furini et al. (2019), "QPLIB: a library of quadratic programming
instances", Math. Prog. Comp. 11, 237-265, and its electronic supplement.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator

import numpy as np

from mortarbench.harness import InputError, Vector
from mortarbench.harness.errors import shortened, unknown
from mortarbench.harness.files.datafile import check_size
from mortarbench.problems.files.two_sided import TwoSidedQP, real_number, sparse

#: accepted letters of the type, and the reason to refuse others
_TYPES = (
    ("LDC", "a nonconvex objective; expected type L, D or C"),
    ("C", "variables that are not continuous; expected type C"),
    ("NBL", "quadratic constraints; expected type N, B or L"),
)


def parse_qplib(text: str) -> TwoSidedQP:
    """Parse the text of a QPLIB file.

    Raises
    ------
    InputError
        If the text is malformed, or the problem is not a convex QP with linear
        constraints; the message states the line.

    """
    file = _Lines(text)
    try:
        return _problem(file)
    except InputError as e:
        message = shortened(str(e), 400)
        raise InputError(f"line {file.line}: {message}") from None


class _Lines:
    """Lines of a file without comments; `line` is the number of the present line."""

    def __init__(self, text: str) -> None:
        self.line = 0
        lines = ((i, line.split()) for i, line in enumerate(text.splitlines(), 1))
        self._lines = deque((i, w) for i, w in lines if w and w[0][0] not in "!%#")

    def has_ended(self) -> bool:
        """Return True if there are no further lines."""
        return not self._lines

    def words(self, count: int) -> list[str]:
        """Return the first `count` words of the next line."""
        if not self._lines:
            raise InputError("the file ends here; expected further sections")
        self.line, words = self._lines.popleft()
        if len(words) < count:
            raise InputError(f"{len(words)} fields; expected {count}")
        return words[:count]

    def integer(self) -> int:
        """Read a nonnegative integer."""
        return _index(self.words(1)[0], math.inf)

    def real(self) -> float:
        """Read a real number."""
        return real_number(self.words(1)[0])

    def vector(self, n: int, infinity: float = math.inf) -> Vector:
        """Read a vector (n,): its default value and the other entries.

        infinity : magnitude from which on an entry is infinite
        """
        vector = np.full(n, self.real())
        for (i,), value in self.entries(n):
            vector[i] = value
        return np.where(abs(vector) < infinity, vector, np.copysign(np.inf, vector))

    def entries(self, *shape: int) -> Iterator[tuple[tuple[int, ...], float]]:
        """Read the number of entries, and yield their indices, from 0, and values."""
        for _ in range(self.integer()):
            *indices, value = self.words(len(shape) + 1)
            yield (
                tuple(_index(i, n, 1) - 1 for i, n in zip(indices, shape, strict=True)),
                real_number(value),
            )

    def matrix(self, m: int, n: int) -> list[tuple[int, int, float]]:
        """Read the entries of a matrix as (row, column, value)."""
        return [(i, j, value) for (i, j), value in self.entries(m, n)]


def _problem(file: _Lines) -> TwoSidedQP:
    file.words(1)  # the name
    (kind,) = file.words(1)
    kind = kind.upper()
    if len(kind) != 3:
        raise InputError(f"type {kind!r}; expected three letters, such as CCL")
    for letter, (accepted, reason) in zip(kind, _TYPES, strict=True):
        if letter not in accepted:
            raise InputError(f"type {kind!r}: {reason}")
    (sense,) = file.words(1)
    senses = ("minimize", "maximize")
    if sense.lower() not in senses:
        raise unknown("sense", sense, senses)
    n = file.integer()
    m = file.integer() if kind[2] == "L" else 0
    check_size("its vectors", 64 * (n + m))
    P = file.matrix(n, n) if kind[0] != "L" else []
    if any(i < j for i, j, _ in P):
        raise InputError("Q⁰ has entries above its diagonal; expected its lower half")
    q, constant = file.vector(n), file.real()
    A = file.matrix(m, n) if kind[2] == "L" else []
    infinity = file.real()
    l, u = ((file.vector(m, infinity) if kind[2] == "L" else np.zeros(0)) for _ in "lu")
    lb, ub = file.vector(n, infinity), file.vector(n, infinity)
    _skip_points_and_names(file, n, m if kind[2] == "L" else None)
    return TwoSidedQP(
        P=sparse(P + [(j, i, value) for i, j, value in P if i != j], (n, n)),
        q=q,
        r=constant,
        A=sparse(A, (m, n)),
        l=l,
        u=u,
        lb=lb,
        ub=ub,
        maximise=sense.lower() == "maximize",
    )


def _skip_points_and_names(file: _Lines, n: int, m: int | None) -> None:
    """Check that starting points and names follow, or nothing.

    Otherwise a section missing before them would not be noticed.

    m : number of constraints; None if the type has none
    """
    if file.has_ended():
        return
    for size in (n, m, n):
        if size is not None:
            file.vector(size)
    for _ in range(2):
        for _ in range(file.integer()):
            file.words(2)
    if not file.has_ended():
        file.words(1)
        raise InputError("further data; expected the end of the file")


def _index(text: str, most: float, least: int = 0) -> int:
    is_integer = text.isascii() and text.isdigit() and len(text) < 16
    if not (is_integer and least <= int(text) <= most):
        wanted = f"an integer from {least}" + (f" to {most}" if most < math.inf else "")
        raise InputError(f"{shortened(text)!r} is not {wanted}")
    return int(text)
