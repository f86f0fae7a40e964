"""Base of the adapters of libraries: every setting of the library is an option."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

from mortarbench.harness import (
    NO_SOLUTION,
    QP,
    Solution,
    Status,
    needs_matrices,
)
from mortarbench.solvers.common.conversion import check_positive
from mortarbench.solvers.common.sequence import Session, chain


@dataclass(frozen=True)
class Adapter:
    """Adapter of a library that accepts the settings of the library by name.

    A setting of the user replaces the value that the adapter would pass, also for
    tolerances, limits of iterations and threads. The verdict on an answer is evaluated
    at the tolerance of the suite in any case.
    """

    #: settings of the library by name; an enumerator is given by its name
    settings: Mapping[str, Any] = field(default_factory=dict, kw_only=True)

    def __post_init__(self) -> None:
        if hasattr(self, "max_iter"):
            check_positive(max_iter=self.max_iter)
        self._of_user()

    def declines(self, qp: QP) -> str | None:
        return needs_matrices(qp)

    def library_settings(self) -> dict[str, Any] | None:
        """Return the settings of the library with their defaults, by name.

        Lists and arrays are omitted. The result is None if the library has no list of
        its settings, or is not installed.
        """
        library: Any = None
        with suppress(ImportError):
            library = self.library()
        if library is not None and not isinstance(library, Mapping):
            names = [name for name in dir(library) if not name.startswith("_")]
            library = {name: getattr(library, name) for name in names}
        return library and {
            name: value if isinstance(value, int | float | str) else value.name
            for name, value in library.items()
            if isinstance(value, int | float | str) or hasattr(value, "name")
        }

    def library(self) -> Any:
        """Return the settings of the library: an object, a mapping, or None."""
        return None

    def tuned(self, **own: Any) -> dict[str, Any]:
        """Return the settings to pass: those of the adapter, then those of the user."""
        return own | self._of_user()

    def tune(self, target: object, **own: Any) -> None:
        """Set the attributes of an object of the library, see `tuned`."""
        for name, value in self.tuned(**own).items():
            setattr(target, name, value)

    def _of_user(self) -> dict[str, Any]:
        """Return `settings` with the enumerators of the library instead of names.

        Raises
        ------
        ValueError
            If the library refuses a value.

        """
        library: Any = None
        with suppress(ImportError):
            library = self.library() if self.settings else None
        settings = dict(self.settings)
        for name, value in settings.items() if library is not None else ():
            is_map, default = isinstance(library, Mapping), None
            try:
                default = library[name] if is_map else getattr(library, name)
                if isinstance(value, str) and not isinstance(default, str):
                    settings[name] = getattr(type(default), value)
                if not is_map:
                    setattr(library, name, settings[name])
            except (LookupError, AttributeError, TypeError, OverflowError) as e:
                names = getattr(type(default), "__members__", ())
                expected = f"; expected one of {', '.join(names)}" if names else ""
                raise ValueError(f"{name} = {value!r}: {e}{expected}") from None
        return settings


class SequenceAdapter(Adapter, ABC):
    """Adapter of a library whose solver objects can be updated for a sequence."""

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        return self._begin(qp, tol).solve

    def chain(self, tol: float) -> Callable[[QP], Callable[[], Solution]]:
        return chain(self._begin, tol)

    @abstractmethod
    def _begin(self, qp: QP, tol: float) -> Session: ...


def concluded(
    qp: QP, status: Status, message: str, multipliers: dict[str, Any], **point: Any
) -> Solution:
    """Return a solution; of a claim that there is none, only a certificate is kept.

    Multipliers that are a certificate of infeasibility remain one in any scaling.

    point : x and further fields of the solution
    """
    if status in NO_SOLUTION:
        ray = multipliers if status is Status.INFEASIBLE else {}
        return Solution.without_point(qp, status, message, **ray)
    return Solution(status=status, message=message, **multipliers, **point)
