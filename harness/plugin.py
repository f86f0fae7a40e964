"""What one can plug in: solvers, and families of problems that build cases."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any, Protocol

from numpy.typing import NDArray

from harness.mechanics import Mechanics
from harness.qp import QP, Vector
from harness.solution import Solution

Value = int | float | str  #: of one key of a case name
Reference = Callable[[QP], Solution]  #: the injected high-accuracy solve


class Solver(Protocol):
    """A QP solver; in practice a frozen dataclass whose fields are its options."""

    def declines(self, qp: QP) -> str | None:
        """Say why this solver cannot take `qp`, or None if it can."""

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        """Convert and factorise; return the call that solves. Both are timed.

        `tol` is the relative KKT accuracy asked for; the adapter maps it to the
        solver's own test. The returned call is made once: repeats prepare afresh.
        """


class Chained(Solver, Protocol):
    """A solver that can carry work from one QP to the next, as of load steps."""

    def chain(self, tol: float) -> Callable[[QP], Callable[[], Solution]]:
        """Begin a sequence: return the `prepare` for its QPs, called in their order.

        Each call may use whatever the earlier ones left (points, multipliers, factors,
        norms), on its own responsibility: the QPs of a sequence need not have a single
        coefficient in common. Sequences are independent of each other.
        """


@dataclass(frozen=True, kw_only=True)
class About:
    """The descriptive facts of a solver, kept with its adapter.

    A solver may have one as its attribute ``about``. Texts are Markdown, a sentence or
    two each. The tolerance mapping is no part of it: it is in the class's docstring.
    """

    title: str
    method: str  #: the class of methods, e.g. "interior point"
    licence: str
    linear_solver: str  #: what solves its linear systems
    phases: str  #: what is timed as preparing and what as solving
    package: str = ""  #: to install, with a module of the same name unless given below
    module: str = ""  #: to import, where its name differs
    sequence: str = ""  #: what it carries from one QP to the next; empty: nothing
    limits: tuple[str, ...] = ()  #: known limits found here, each with its evidence

    @property
    def missing(self) -> str | None:
        """Say what to install, or None if the library can be imported."""
        module = self.module or self.package
        if not module or find_spec(module) is not None:
            return None
        return f"not installed: {module} (pip install {self.package})"


@dataclass(frozen=True, eq=False, kw_only=True)
class Fields:
    """A deformed state of bodies, for pictures and files; SI units."""

    points: NDArray[Any]  #: (N, 2) reference positions, m
    cells: NDArray[Any]  #: (E, 4) node numbers, counter-clockwise
    bodies: NDArray[Any]  #: (E,) body number of each cell
    displacement: NDArray[Any]  #: (N, 2) m
    nodal: Mapping[str, Vector] = field(default_factory=dict)  #: e.g. von_mises (N,) Pa
    contact_nodes: NDArray[Any] | None = None  #: (c,) slave nodes of the contact rows
    contact_forces: NDArray[Any] | None = None  #: (c, 2) force on each slave node, N/m


@dataclass(frozen=True, eq=False, kw_only=True)
class Case:
    """One QP together with its way back to the physical problem.

    `scale` and `constant` turn the objective of the emitted QP into the potential
    energy of the physical problem:  energy = scale·objective + constant.
    """

    qp: QP
    recover: Callable[[Solution], Vector]  #: point of the QP → physical unknown u, SI
    quantities: Callable[[Solution], Mapping[str, Any]]  #: physical results, SI
    fields: Callable[[Solution], Fields] | None = None  #: for pictures, where there are
    scale: float = 1.0
    constant: float = 0.0
    matrices: Mapping[str, Any] = field(default_factory=dict)  #: to export with the QP
    dualise_seconds: float | None = (
        None  #: what a dual form took to come by, factor too
    )
    mechanics: Mechanics | None = None  #: to certify errors with, where there are any


class Family(Protocol):
    """A parametrised family of problems; in practice a frozen dataclass."""

    @property
    def name(self) -> str:
        """The first component of its case names."""

    @property
    def defaults(self) -> Mapping[str, Value]:
        """Every key with its default, in the order of canonical names."""

    @property
    def forms(self) -> tuple[str, ...]:
        """The forms that it can emit."""

    def build(
        self, form: str, params: Mapping[str, Value], reference: Reference
    ) -> Case:
        """Build one case from complete params.

        A family may also have ``check(params) -> None``, which is called before a run
        starts, and ``complete(given) -> params`` where a default depends on another
        key. All raise `InputError` for values outside the family's range. One with
        ``path_suffix`` takes a file; see `harness.names`.

        One with ``refined(params) -> params`` says which case has every cell halved,
        for `harness.crossval.discretisation`; its mechanics have a grid. A text
        ``singular`` says why refinement has no limit of finite energy, where it has
        none.
        """
