"""Interfaces for plug-ins: solvers, families of problems, and the cases they build."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from importlib.util import find_spec
from typing import (
    TYPE_CHECKING,
    Any,
    ClassVar,
    NamedTuple,
    Protocol,
    Self,
    TypeAlias,
)

from mortarbench.harness.keys import Value, keys_of

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from mortarbench.harness.distributed.comm import Team
    from mortarbench.harness.mechanics import (
        CellBlock,
        DecomposedMechanics,
        Mechanics,
    )
    from mortarbench.harness.qp import QP, Vector
    from mortarbench.harness.solution import Solution

#: Function that solves a QP accurately. Families receive it instead of importing a
#: solver.
Reference: TypeAlias = "Callable[[QP], Solution]"


class ReferenceOfOperator(Protocol):
    """Function that accurately solves a QP whose P is an operator."""

    def __call__(self, qp: QP, start: Solution | None = None, /) -> Solution:
        """Solve a QP to high accuracy.

        start : initial guess, a solution of a QP that differs from `qp` only in the
            bounds
        """


class Solver(Protocol):
    """A QP solver, usually a frozen dataclass whose fields are the options.

    The class attribute ``accepts``, a tuple of classes of `harness.sets`, declares the
    convex sets that the solver supports. A solver without this attribute accepts only
    bounds, as with ``(Box,)``. QPs with other sets are declined without a call of
    `declines`.

    A solver that passes settings to a library may have a field ``settings``, a mapping,
    and a method ``library_settings()`` that returns the defaults of all settings by
    name, or None if the library does not list them. These settings are then options of
    the solver, see `solvers.common.adapter`.

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
        """Return the reason to decline `qp`, or None if the solver accepts `qp`."""

    def prepare(self, qp: QP, tol: float) -> Callable[[], Solution]:
        """Convert and factorise the data of `qp`, and return a function that solves it.

        The call of `prepare` and the call of the returned function are timed. The
        returned function is called once, since every repeat starts with `prepare`.

        tol : requested tolerance of the relative KKT residuals, which the adapter
            translates into the stopping criterion of the solver
        """


class Chained(Solver, Protocol):
    """A solver that can reuse work within a sequence of QPs, such as load steps."""

    def chain(self, tol: float) -> Callable[[QP], Callable[[], Solution]]:
        """Begin a sequence, and return a `prepare` function for its QPs.

        The returned function is called for each QP in the order of the sequence. A call
        may reuse results of earlier calls (points, multipliers, factors, norms). The
        solver must check that these results still apply, since the QPs of a sequence
        may differ in every coefficient. Two sequences must not share any data.
        """


@dataclass(frozen=True, kw_only=True)
class About:
    """Description of a solver, for lists and reports.

    A solver may have an `About` as its attribute ``about``. The texts are Markdown and
    have at most a few sentences. The docstring of the solver's class, rather than this
    description, explains the translation of the tolerance.
    """

    title: str
    method: str  #: class of methods, e.g. "interior point"
    licence: str
    linear_solver: str  #: solver used for the linear systems of the method
    #: work that is timed as preparation, and work that is timed as solution
    phases: str
    #: package to install; its module has the same name unless `module` is set
    package: str = ""
    module: str = ""  #: name of the module, if it differs from the name of the package
    #: work that is reused from one QP to the next, or "" if no work is reused
    sequence: str = ""
    limits: tuple[str, ...] = ()  #: known limitations, each with evidence

    @property
    def missing(self) -> str | None:
        """Message with the package to install, or None if no package is missing."""
        module = self.module or self.package
        if not module or find_spec(module) is not None:
            return None
        return f"not installed: {module} (pip install {self.package})"


#: State of a node without contact pressure whose shear has reached the bound of
#: Tresca's law. This bound does not depend on the pressure.
SLIDING = "sliding without contact"


@dataclass(frozen=True, eq=False, kw_only=True)
class ContactSide:
    """Results of one contact at the s nodes of its slave side, in SI units."""

    name: str  #: name of the pair of bodies, such as "disc on plate"
    nodes: NDArray[Any]  #: (s,) numbers of the nodes along the side
    #: (s,) length of the undeformed side attributed to each node, m, or area, m²; at
    #: nodes with a row, the part that the master covers
    length: Vector
    #: (s, dim) force of this contact on each slave node: N/m in 2D, N in 3D
    force: NDArray[Any]
    pressure: Vector  #: (s,) contact pressure in Pa, positive in compression
    #: (s,) gap in m, positive if open; NaN at nodes without an opposite side
    gap: Vector
    #: (s,) compressive force along the normal of the contact row of each node: N/m in
    #: 2D, N in 3D
    push: Vector | None = None
    #: (s,) tangential traction on the side, Pa; in 3D the magnitude of the traction
    shear: Vector | None = None
    #: (s,) "open", "stick", "slip" or `SLIDING`; "" at nodes without a contact row. Old
    #: files contain "open" in place of both `SLIDING` and ""
    friction: NDArray[Any] | None = None
    friction_force: NDArray[Any] | None = None  #: (s, dim) tangential part of `force`
    #: (k, 3) analytical solution, if known. Columns: distance along the side from its
    #: middle, m; pressure, Pa; shear, Pa
    exact: NDArray[Any] | None = None

    def pressed(self, least: float) -> NDArray[Any]:
        """Return the mask (s,) of the nodes in contact.

        With friction, a node is in contact if the node sticks or slips. A force is not
        a sufficient criterion, since under Tresca's law forces also act without
        contact. Without friction, a node is in contact if its `push`, or the norm of
        its force if `push` is None, exceeds `least` (in the unit of forces). The norm
        of the force is a less accurate criterion than `push`, because on a curved side
        a mortar row also causes tangential forces at adjacent nodes.
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
    """A deformed state of all bodies, for plots and VTK files, in SI units."""

    points: NDArray[Any]  #: (N, dim) reference positions of the nodes, m
    #: node numbers: (E, 4) in 2D, counter-clockwise, where a triangle repeats its last
    #: node; (E, c) in 3D, see `harness.mechanics.cell_blocks`
    cells: NDArray[Any]
    bodies: NDArray[Any]  #: (E,) body number of each cell
    displacement: NDArray[Any]  #: (N, dim) displacement of each node, m
    #: nodal results by name, e.g. von_mises (N,), Pa
    nodal: Mapping[str, Vector] = field(default_factory=dict)
    contact_nodes: NDArray[Any] | None = None  #: (c,) slave nodes of the contact rows
    #: (c, dim) force on each slave node: N/m in 2D, N in 3D
    contact_forces: NDArray[Any] | None = None
    #: contact sides, one for each pair of bodies
    contacts: tuple[ContactSide, ...] = ()
    #: (E,) subdomain of each cell, from 0; None for undivided bodies
    subdomains: NDArray[Any] | None = None

    @property
    def dim(self) -> int:
        """Dimension of space, 2 or 3."""
        return int(self.points.shape[1])

    @property
    def blocks(self) -> tuple[CellBlock, ...]:
        """Cells grouped by type, with the type names of meshio."""
        # imported here, since this import loads NumPy
        from mortarbench.harness.mechanics import cell_blocks

        return cell_blocks(self.cells, self.dim)


@dataclass(frozen=True, eq=False, kw_only=True)
class Case:
    """A QP, and the maps from its solution to physical results.

    The potential energy of the physical problem is scale·objective + constant, where
    `objective` is the objective of the QP.
    """

    qp: QP
    #: maps a solution of the QP to the physical unknown u, SI
    recover: Callable[[Solution], Vector]
    #: maps a solution of the QP to physical results, SI
    quantities: Callable[[Solution], Mapping[str, Any]]
    #: maps a solution of the QP to the deformed state, for plots
    fields: Callable[[Solution], Fields] | None = None
    scale: float = 1.0
    constant: float = 0.0
    #: matrices by name that are exported with the QP
    matrices: Mapping[str, Any] = field(default_factory=dict)
    #: time to form the dual, including the factorisation; None for other forms
    dualise_seconds: float | None = None
    mechanics: Mechanics | None = None  #: elastic problem, needed to certify errors
    #: maps a solution of the QP to the data of its certificate, if bodies are only
    #: known by their subdomains: bodies, displacement, and multipliers of contact and
    #: of friction with positive bounds
    certifiable: (
        Callable[[Solution], tuple[DecomposedMechanics, Vector, Vector]] | None
    ) = None
    #: digest of the QP, if its coefficients have rounding errors that depend on the
    #: number of ranks; empty to compute it from the coefficients
    digest: str = ""
    remarks: tuple[str, ...] = ()  #: warnings about the input; each is a single line


class Divided(NamedTuple):
    """The subdomains of a case."""

    subdomains: int  #: number of subdomains, which is the largest number of ranks
    #: builds the case on rank 0, while the other ranks serve
    build: Callable[[Team, ReferenceOfOperator], Case]


class Family(ABC):
    """A parametrised family of problems: a frozen dataclass whose fields are its keys.

    Keys are annotated with their type, range and help text (`harness.keys`); the order
    of the fields is the order of keys in canonical names. The registry contains the
    family with default values, and a case contains the family with its own values.
    Methods, including ``__post_init__``, raise `InputError` if values are not
    supported. The messages do not contain the name of the family, which the caller
    prepends.

    Examples
    --------
    >>> from dataclasses import dataclass
    >>> from typing import Annotated, ClassVar
    >>> import mortarbench as mb
    >>> @dataclass(frozen=True, kw_only=True)
    ... class Spring(mb.Family):
    ...     forms: ClassVar = ("primal",)
    ...     k: Annotated[float, mb.Range(0, 1e9), "stiffness"] = 2.0
    ...
    ...     def build(self, form, reference):
    ...         qp = mb.QP.from_arrays([[self.k]], [-1])
    ...         return mb.Case(
    ...             qp=qp, recover=lambda s: s.x,
    ...             quantities=lambda s: {"u": float(s.x[0])},
    ...         )
    >>> Spring(k=4.0)
    Spring(k=4.0)
    >>> Spring(k=-1)
    Traceback (most recent call last):
    ...
    mortarbench.harness.errors.InputError: k=-1 must be between 0 and 1e+09
    """

    forms: ClassVar[tuple[str, ...]]  #: names of the forms, such as "primal" and "dual"
    #: suffix of the input files; see `harness.names`
    path_suffix: ClassVar[str | None] = None

    def __post_init__(self) -> None:
        """Check that every value is in its range; subclasses add further checks."""
        for name, key in keys_of(type(self)).items():
            if (value := getattr(self, name)) is not None:
                key.check(value)

    def derive(self, **values: Value) -> None:
        """Set the keys that have their default `DERIVED`; call from __post_init__."""
        for name, value in values.items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, value)

    def with_keys(self, **values: Value) -> Self:
        """Return the family with these values, and the defaults of all other keys."""
        defaults = {name: key.default for name, key in keys_of(type(self)).items()}
        return replace(self, **(defaults | values))  # type: ignore[type-var]

    @property
    def params(self) -> dict[str, Value]:
        """Values of all keys."""
        return {name: getattr(self, name) for name in keys_of(type(self))}

    @abstractmethod
    def build(self, form: str, reference: Reference) -> Case:
        """Build the case in the given form.

        reference : function that solves a QP accurately, e.g. for previous load steps
        """

    def problems_in(self, path: str) -> list[str]:
        """Return the paths of the problems in an input file, such as PATH#1, PATH#2."""
        return [path]

    def divided(self, form: str) -> Divided | None:
        """Return the subdomains of a form, or None if it is not in subdomains.

        This method does not build the QP and does not need MPI.
        """
        return None
