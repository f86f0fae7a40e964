"""What one can plug in: solvers, and families of problems that build cases."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Protocol, TypeAlias

if TYPE_CHECKING:
    from pathlib import Path

    from numpy.typing import NDArray

    from mortarbench.harness.distributed.vectors import DistributedQP, Ranks
    from mortarbench.harness.mechanics import CellBlock, Mechanics
    from mortarbench.harness.qp import QP, Vector
    from mortarbench.harness.solution import Solution

Value = int | float | str  #: of one key of a case name
#: the injected high-accuracy solve
Reference: TypeAlias = "Callable[[QP], Solution]"


class ReferenceOverRanks(Protocol):
    """The injected high-accuracy solve of shares of a QP; called by all ranks."""

    def __call__(self, qp: QP, start: Solution | None = None, /) -> Solution:
        """Solve; `start` is a solution of a QP that differs in its bounds alone."""


class Solver(Protocol):
    """A QP solver; in practice a frozen dataclass whose fields are its options.

    A class attribute ``accepts``, a tuple of classes of `harness.sets`,
    declares the convex sets that it can take. Without it a solver accepts bounds alone
    (``(Box,)``), and declines QPs with other sets before `declines` is called.
    """

    def declines(self, qp: QP) -> str | None:
        """Give the reason why this solver cannot take `qp`, or None if it can."""

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


class Tightening(Chained, Protocol):
    """A solver that can carry work on where each QP comes with its own tolerance."""

    def tightening(self) -> Callable[[QP, float], Callable[[], Solution]]:
        """Begin a sequence: return the `prepare` for its QPs and their tolerances.

        As `chain`, which has one tolerance for all: the early QPs of a fixed point are
        not worth solving as accurately as the last.
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


#: state of a node whose bound of Tresca's law carries shear where nothing presses
SLIDING = "sliding without contact"


@dataclass(frozen=True, eq=False, kw_only=True)
class ContactSide:
    """What a contact does along its slave side, node by node; SI units."""

    name: str  #: of the pair of bodies, such as "disc on plate"
    nodes: NDArray[Any]  #: (s,) along the side
    length: Vector  #: (s,) of the undeformed side that belongs to each node, m
    force: NDArray[Any]  #: (s, dim) on each node by this contact, N/m; in space N
    pressure: Vector  #: (s,) Pa; positive where the bodies press on each other
    gap: Vector  #: (s,) m; positive: open; NaN where nothing is opposite
    #: (s,) force on each node against the normal of its own contact row, N/m
    push: Vector | None = None
    shear: Vector | None = None  #: (s,) tangential traction on the side, Pa
    #: (s,) "open", "stick", "slip" or `SLIDING`; files of old say "open" for the last
    friction: NDArray[Any] | None = None
    #: (k, 3) of the exact solution, where it is known: distance along the side from its
    #: middle, m, pressure and shear, Pa
    exact: NDArray[Any] | None = None

    def pressed(self, least: float) -> NDArray[Any]:
        """Tell which nodes (s,) press on the other side.

        Those with a push, or where it is not known a force, of more than `least`, N/m:
        a mortar row of a curved side also pulls along the side at the neighbours of its
        node. With friction it is those that stick or slip: Tresca's law lets friction
        act where nothing presses, too.
        """
        told: NDArray[Any]
        if self.friction is not None:
            told = (self.friction == "stick") | (self.friction == "slip")
        elif self.push is not None:
            told = self.push > least
        else:
            told = (self.force**2).sum(axis=1) > least**2
        return told


@dataclass(frozen=True, eq=False, kw_only=True)
class Fields:
    """A deformed state of bodies, for pictures and files; SI units."""

    points: NDArray[Any]  #: (N, dim) reference positions, m
    #: (E, 4) node numbers, counter-clockwise; a triangle repeats its last node
    cells: NDArray[Any]
    bodies: NDArray[Any]  #: (E,) body number of each cell
    displacement: NDArray[Any]  #: (N, dim) m
    nodal: Mapping[str, Vector] = field(default_factory=dict)  #: e.g. von_mises (N,) Pa
    contact_nodes: NDArray[Any] | None = None  #: (c,) slave nodes of the contact rows
    #: (c, dim) force on each slave node: N/m in the plane, N in space
    contact_forces: NDArray[Any] | None = None
    contacts: tuple[ContactSide, ...] = ()  #: each pair on its own
    #: (E,) subdomain of each cell, from 0; None for bodies that are not torn
    subdomains: NDArray[Any] | None = None

    @property
    def dim(self) -> int:
        """Number of coordinates of a point."""
        return int(self.points.shape[1])

    @property
    def blocks(self) -> tuple[CellBlock, ...]:
        """Cells by their kinds, in the vocabulary of meshio."""
        from mortarbench.harness.mechanics import cell_blocks  # late: loads numpy

        return cell_blocks(self.cells, self.dim)


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
    remarks: tuple[str, ...] = ()  #: what may be wrong with the input, a line each
    #: how far the QP itself is from the fixed point that it leads to, relative: no
    #: solution of it comes nearer; 0 where it leads to none, or is there
    unsettled: float = 0.0


@dataclass(frozen=True, kw_only=True)
class SourceFile:
    """A file that a case is read from, with the content that it had when named."""

    path: str  #: as the case names it
    sha256: str  #: first 12 hexadecimal digits
    suffix: str  #: of its format, for the name of a copy; never taken from the path


class Family(ABC):
    """A parametrised family of problems; in practice a frozen dataclass.

    All methods raise `InputError` for values outside the family's range.
    """

    name: str  #: the first component of its case names
    defaults: Mapping[str, Value]  #: every key, in the order of canonical names
    forms: tuple[str, ...]  #: that it can emit
    path_suffix: str | None = None  #: where it takes a file; see `harness.names`
    singular: str = ""  #: why refinement has no limit of finite energy, if it has none

    @abstractmethod
    def build(
        self, form: str, params: Mapping[str, Value], reference: Reference
    ) -> Case:
        """Build one case from complete params."""

    def complete(self, given: Mapping[str, Value]) -> Mapping[str, Value]:
        """Add the keys that are not given; a default may depend on another key."""
        return {**self.defaults, **given}

    def check(self, params: Mapping[str, Value]) -> None:  # noqa: B027  # may be none
        """Refuse complete params out of range; called before a run starts."""

    def refined(self, params: Mapping[str, Value]) -> Mapping[str, Value] | None:
        """Give the case whose mesh has every cell halved; None where there is none.

        The mechanics of both have a grid, for `harness.crossval.discretisation`.
        """
        return None

    def unrefined(self, params: Mapping[str, Value]) -> str:
        """Describe the part of the geometry that `refined` leaves coarse, or "".

        The words follow an error of the mesh: "of the bodies as they are meshed".
        """
        return ""

    def source_file(self, params: Mapping[str, Value]) -> SourceFile | None:
        """Return the file that a case is read from, to be copied with its results."""
        return None

    def with_copies(self, folder: Path) -> Family:
        """Return the family that takes the copies of a result folder.

        They stand for files that are missing here, or have another content.
        """
        return self

    def copied_paths(self) -> list[str]:
        """List the paths of files that the result folder knows; see `with_copies`."""
        return []

    def emission(
        self, form: str, params: Mapping[str, Value]
    ) -> Callable[[Ranks, ReferenceOverRanks], DistributedQP] | None:
        """Say how ranks make their shares of what `build` would emit, complete params.

        All ranks call what is returned, with a reference that solves shares of a QP on
        all of them together. None where that is not built: one process emits
        the whole then. Neither needs MPI to be there, nor builds anything yet.
        """
        return None


def as_family(offered: Any) -> Family:
    """Give what somebody offers as a family, wrapped if its class does not inherit.

    offered : has `name`, `defaults`, `forms` and `build`, and may have what else
        `Family` has
    """
    if isinstance(offered, Family):
        return offered
    kind = type(offered)
    parts = [name for name in dir(Family) if not name.startswith("_")]
    own = {name: getattr(offered, name) for name in parts if hasattr(offered, name)}
    required = ("name", "defaults", "forms", "build")
    own |= {name: getattr(offered, name, None) for name in required}
    own = {k: staticmethod(v) if callable(v) else v for k, v in own.items()}
    wrapped: Family = type(kind.__name__, (Family,), {"__doc__": kind.__doc__, **own})()
    return wrapped
