"""Protocols for plug-ins: solvers, and families of problems that build cases."""

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

Value = int | float | str  #: value of a key in a case name
#: The injected high-accuracy solve.
Reference: TypeAlias = "Callable[[QP], Solution]"


class ReferenceOverRanks(Protocol):
    """The injected high-accuracy solve of a distributed QP; called by all ranks."""

    def __call__(self, qp: QP, start: Solution | None = None, /) -> Solution:
        """Solve a QP.

        start : a solution of a QP that differs only in its bounds
        """


class Solver(Protocol):
    """A QP solver; in practice a frozen dataclass whose fields are its options.

    The class attribute ``accepts``, a tuple of classes of `harness.sets`, declares the
    convex sets that the solver supports. Without it a solver accepts bounds only
    (``(Box,)``). QPs with other sets are declined before `declines` is called.

    Examples
    --------
    A solver for QPs without constraints other than equations:

    >>> from dataclasses import dataclass
    >>> import numpy as np
    >>> import mortarbench as mb
    >>> @dataclass(frozen=True)
    ... class Saddle:
    ...     def declines(self, qp):
    ...         has_bounds = qp.h.size or np.isfinite([qp.lb, qp.ub]).any()
    ...         return "needs equations only" if has_bounds else None
    ...
    ...     def prepare(self, qp, tol):
    ...         n, m = qp.q.size, qp.b.size
    ...         M = np.block([[qp.P, qp.A.T], [qp.A, np.zeros((m, m))]])
    ...         inverse = np.linalg.inv(M)  # timed as preparation
    ...
    ...         def solve():
    ...             x, y = np.split(inverse @ np.append(-qp.q, qp.b), [n])
    ...             return mb.Solution(
    ...                 status=mb.Status.SOLVED, x=x, y=y, z=np.zeros(0),
    ...                 z_box=np.zeros(n),
    ...             )
    ...
    ...         return solve
    >>> qp = mb.QP.from_arrays(np.eye(2), [-1, 0], A=[1, 1], b=1)
    >>> mb.solve(qp, Saddle()).verdict.value
    'verified'

    """

    def declines(self, qp: QP) -> str | None:
        """Return the reason why this solver does not accept `qp`, or None."""

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        """Convert and factorise; return a function that solves. Both are timed.

        `tol` is the requested relative accuracy of the KKT residuals; the adapter
        translates it to the stopping test of the solver. The returned function is
        called once: every repeat starts with `prepare`.
        """


class Chained(Solver, Protocol):
    """A solver that can reuse work from one QP to the next, such as load steps."""

    def chain(self, tol: float) -> Callable[[QP], Callable[[], Solution]]:
        """Begin a sequence; return the `prepare` for its QPs, called in their order.

        Each call may reuse results of earlier ones (points, multipliers, factors,
        norms). The solver must check that they still apply: the QPs of a sequence may
        differ in every coefficient. Sequences are independent of each other.
        """


class Tightening(Chained, Protocol):
    """A solver that can reuse work if each QP has its own tolerance."""

    def tightening(self) -> Callable[[QP, float], Callable[[], Solution]]:
        """Begin a sequence: return the `prepare` for its QPs and their tolerances.

        The early QPs of a fixed point iteration need not be solved as accurately as the
        last one, so that `prepare` also takes a tolerance.
        """


@dataclass(frozen=True, kw_only=True)
class About:
    """Description of a solver, for lists and reports.

    A solver may have one as its attribute ``about``. Texts are Markdown, a sentence or
    two each. The translation of the tolerance belongs in the docstring of the class.
    """

    title: str
    method: str  #: class of methods, e.g. "interior point"
    licence: str
    linear_solver: str  #: solver of its linear systems
    phases: str  #: work timed as preparing, and work timed as solving
    package: str = (
        ""  #: package to install; its module has the same name unless `module` is set
    )
    module: str = ""  #: name of the module to import, if it differs
    sequence: str = ""  #: work reused from one QP to the next; empty for none
    limits: tuple[str, ...] = ()  #: known limitations, each with evidence

    @property
    def missing(self) -> str | None:
        """The package to install, or None if the library can be imported."""
        module = self.module or self.package
        if not module or find_spec(module) is not None:
            return None
        return f"not installed: {module} (pip install {self.package})"


#: State of a node without pressure that transmits shear up to the bound of Tresca's
#: law.
SLIDING = "sliding without contact"


@dataclass(frozen=True, eq=False, kw_only=True)
class ContactSide:
    """Results of a contact along its slave side, node by node; SI units."""

    name: str  #: name of the pair of bodies, such as "disc on plate"
    nodes: NDArray[Any]  #: (s,) numbers of the nodes along the side
    length: Vector  #: (s,) share of the undeformed side of each node, m
    force: NDArray[Any]  #: (s, dim) force of this contact on each node, N/m; N in space
    pressure: Vector  #: (s,) Pa, positive in compression
    gap: Vector  #: (s,) m, positive if open; NaN without an opposite side
    #: (s,) compressive force along the normal of the contact row of each node, N/m
    push: Vector | None = None
    #: (s,) tangential traction on the side, Pa; in space its size
    shear: Vector | None = None
    #: (s,) "open", "stick", "slip" or `SLIDING`, "" for nodes without a contact row;
    #: old files have "open" for the last two
    friction: NDArray[Any] | None = None
    friction_force: NDArray[Any] | None = None  #: (s, dim) part of `force`, tangential
    #: (k, 3) exact solution, if known: distance along the side from its middle, m,
    #: pressure and shear, Pa
    exact: NDArray[Any] | None = None

    def pressed(self, least: float) -> NDArray[Any]:
        """Return the mask (s,) of the nodes in contact.

        With friction, these nodes stick or slip; under Tresca's law, forces also act
        without contact. Without friction, their `push` exceeds `least` (N/m), or their
        force if `push` is unknown. Forces alone are misleading: a mortar row of a
        curved side also has tangential forces at the neighbours of its node.
        """
        mask: NDArray[Any]
        if self.friction is not None:
            mask = (self.friction == "stick") | (self.friction == "slip")
        elif self.push is not None:
            mask = self.push > least
        else:
            mask = (self.force**2).sum(axis=1) > least**2
        return mask


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
    contacts: tuple[ContactSide, ...] = ()  #: one for each pair of bodies
    #: (E,) subdomain of each cell, from 0; None for undivided bodies
    subdomains: NDArray[Any] | None = None

    @property
    def dim(self) -> int:
        """Dimension of space."""
        return int(self.points.shape[1])

    @property
    def blocks(self) -> tuple[CellBlock, ...]:
        """Cells by kind, with the names of meshio."""
        from mortarbench.harness.mechanics import cell_blocks  # loads NumPy

        return cell_blocks(self.cells, self.dim)


@dataclass(frozen=True, eq=False, kw_only=True)
class Case:
    """A QP, and the maps from its solution to physical results.

    `scale` and `constant` convert the objective of the QP to the potential energy of
    the physical problem:  energy = scale·objective + constant.
    """

    qp: QP
    recover: Callable[
        [Solution], Vector
    ]  #: solution of the QP ↦ physical unknown u, SI
    quantities: Callable[
        [Solution], Mapping[str, Any]
    ]  #: solution of the QP ↦ physical results, SI
    fields: Callable[[Solution], Fields] | None = None  #: deformed state, for pictures
    scale: float = 1.0
    constant: float = 0.0
    matrices: Mapping[str, Any] = field(default_factory=dict)  #: exported with the QP
    #: time of forming a dual, with the factorisation; None for other forms
    dualise_seconds: float | None = None
    mechanics: Mechanics | None = None  #: needed to certify errors
    remarks: tuple[str, ...] = ()  #: warnings about the input, a line each
    #: relative distance of the QP from the fixed point of its iteration, such as that
    #: of Coulomb's law; no solution of this QP can reduce it. 0 without an iteration
    unsettled: float = 0.0


@dataclass(frozen=True, kw_only=True)
class SourceFile:
    """A file that a case is read from, identified by its content."""

    path: str  #: path in the name of the case
    sha256: str  #: first 12 hexadecimal digits
    #: suffix of the format, for the name of a copy; not taken from the path
    suffix: str


class Family(ABC):
    """A parametrised family of problems; in practice a frozen dataclass.

    All methods raise `InputError` for values outside the family's range.

    Examples
    --------
    >>> from collections.abc import Mapping
    >>> from dataclasses import dataclass, field
    >>> import numpy as np
    >>> import mortarbench as mb
    >>> @dataclass(frozen=True)
    ... class Spring(mb.Family):
    ...     name: str = "spring"
    ...     defaults: Mapping = field(default_factory=lambda: {"k": 2.0})
    ...     forms: tuple = ("primal",)
    ...
    ...     def build(self, form, params, reference):
    ...         qp = mb.QP.from_arrays([[params["k"]]], [-1])
    ...         return mb.Case(
    ...             qp=qp, recover=lambda s: s.x,
    ...             quantities=lambda s: {"u": float(s.x[0])},
    ...         )
    >>> Spring().complete({})
    {'k': 2.0}

    """

    name: str  #: first component of its case names
    defaults: Mapping[str, Value]  #: all keys, in the order of canonical names
    forms: tuple[str, ...]  #: forms of the QPs
    path_suffix: str | None = None  #: suffix of the input files; see `harness.names`
    #: reason why the energy diverges under refinement; empty if it converges
    singular: str = ""

    @abstractmethod
    def build(
        self, form: str, params: Mapping[str, Value], reference: Reference
    ) -> Case:
        """Build one case from complete params."""

    def complete(self, given: Mapping[str, Value]) -> Mapping[str, Value]:
        """Return params with the missing keys; a default may depend on another key."""
        return {**self.defaults, **given}

    def check(self, params: Mapping[str, Value]) -> None:  # noqa: B027  # may be none
        """Raise InputError for complete params out of range; called before a run."""

    def refined(self, params: Mapping[str, Value]) -> Mapping[str, Value] | None:
        """Return the params of the case with every cell halved, or None.

        The mechanics of both cases need a grid, see `harness.crossval.discretisation`.
        """
        return None

    def unrefined(self, params: Mapping[str, Value]) -> str:
        """Describe the part of the geometry that `refined` does not refine, or "".

        The text is printed after an error of the mesh, such as "of the bodies as they
        are meshed".
        """
        return ""

    def source_file(self, params: Mapping[str, Value]) -> SourceFile | None:
        """Return the file from which a case is read; results contain a copy of it."""
        return None

    def with_copies(self, folder: Path) -> Family:
        """Return the family with the copied files of a result folder.

        The copies replace files that are missing here or have different content.
        """
        return self

    def copied_paths(self) -> list[str]:
        """List the paths of the copied files, see `with_copies`."""
        return []

    def emission(
        self, form: str, params: Mapping[str, Value]
    ) -> Callable[[Ranks, ReferenceOverRanks], DistributedQP] | None:
        """Return a function that assembles the QP of `build` on ranks, or None.

        All ranks call the returned function, with a reference solver for distributed
        QPs. None means that one process builds the QP. The method itself builds nothing
        and does not need MPI.

        params : values of all keys
        """
        return None


def as_family(offered: Any) -> Family:
    """Return an object as a `Family`, wrapped if its class does not inherit from that.

    offered : has `name`, `defaults`, `forms` and `build`, and optionally the other
        members of `Family`
    """
    if isinstance(offered, Family):
        return offered
    kind = type(offered)
    parts = [name for name in dir(Family) if not name.startswith("_")]
    members = {name: getattr(offered, name) for name in parts if hasattr(offered, name)}
    required = ("name", "defaults", "forms", "build")
    members |= {name: getattr(offered, name, None) for name in required}
    members = {k: staticmethod(v) if callable(v) else v for k, v in members.items()}
    wrapped: Family = type(
        kind.__name__, (Family,), {"__doc__": kind.__doc__, **members}
    )()
    return wrapped
