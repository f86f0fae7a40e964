"""Estimate of the discretisation error, which bounds the useful accuracy of a solver.

Let u be the exact solution, û the reference solution on the mesh of the case, and u_h,
u_{h/2}, u_{h/4} solutions on meshes with successively halved cell size h. Each solution
is interpolated onto the next mesh. The distances of successive solutions in the energy
norm ‖·‖ determine the rate of convergence and the remaining error (Richardson
extrapolation of squared errors):

    2^q = ‖u_h − u_{h/2}‖² / ‖u_{h/2} − u_{h/4}‖²
    ‖u_h − u‖² = ‖u_h − u_{h/2}‖² / (1 − 2^−q)                                       (1)

with q = 2 for linear and bilinear elements if u is smooth. Without contact, (1) follows
from Galerkin orthogonality in nested spaces. Contact adds the work of the contact
pressure on the differences of the gaps, which is of higher order if few nodes change
state. Estimates are relative to ‖û‖, like the bounds of `harness.verify.certificate`.

An estimate by differences of potential energies, ‖u_h − u‖² ≤ 2(J_h − J), would be
simpler. However, these differences contain terms of the same order in h that are not
errors of u, because each mesh approximates a curved side by a different polygon with
different boundary values. The energy estimate is 1.5 times the true error on the
membrane, and an eighth of the true error on a cylinder with four cells per contact
half-width. A load step is linearised at the previous solution on the same mesh, and the
effect of this linearisation counts as part of the error. Under a point load, the energy
decreases without limit, like log h. In this case, only the distance to the solution on
the next mesh is reported.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field, replace
from math import log2, sqrt
from pathlib import Path
from time import perf_counter

from mortarbench.harness.crossval.comparison import brief
from mortarbench.harness.crossval.mesh_refinement import (
    NonNestedMeshError,
    prolongation,
)
from mortarbench.harness.crossval.references import UnsolvedError, reference_point
from mortarbench.harness.errors import InputError
from mortarbench.harness.files.durable import replace_file, report_full_disk
from mortarbench.harness.files.reading import read_json
from mortarbench.harness.mechanics import Extended, Grid, Mechanics, Real
from mortarbench.harness.names import CaseId, assemble, unbuilt
from mortarbench.harness.plugin import Family, Reference

#: name of the file with the estimates in the result folder
FILE = "discretisation.json"
SCHEMA = 1  #: version of the format of the file
MAX_UNKNOWNS = 200_000  #: largest number of unknowns of a mesh that is used
#: Assumed ratio of the numbers of unknowns after and before the first halving of the
#: cell size. For later halvings, the ratio of the previous halving is assumed.
GROWTH = 4.0
#: Exponent p in the assumption that the time of a reference solve grows as unknowns^p.
TIME_EXPONENT = 1.5
MAX_LEVELS = 3  #: number of meshes, the smallest number that determines a rate
#: smallest q for extrapolation; for a smaller q, 1/(1 − 2^−q) exceeds 3.4
MIN_RATE = 0.5
#: Smallest assumed relative error of u_h, even if its certificate proves a smaller
#: error, since coefficients of slender bodies are subject to rounding in double
#: precision.
ROUNDING = 1e-8


@dataclass(frozen=True, kw_only=True)
class Level:
    """Norm, energy and error bound of the solution on one mesh."""

    case: str  #: canonical name of the case
    unknowns: int  #: number of unknowns on the mesh
    energy: float  #: potential energy J_h, J/m in 2D, J in 3D
    norm: float  #: energy norm of u_h, in the square root of the unit of energy
    #: certified bound on the relative error of the reference solve on this mesh
    bound: float
    #: energy norm of the difference from the previous level; None on the first level
    distance: float | None = None


@dataclass(frozen=True, kw_only=True)
class Discretisation:
    """Discretisation error of one physical case.

    kind : meaning of `error`. For "limit", `error` is the extrapolated distance to the
        limit of fine meshes; for "change", the distance to the solution on the next
        mesh; for "rounding", an upper bound at the level of rounding errors. For
        "unknown", there is no estimate, and `note` states the reason
    """

    case: str  #: canonical name without the form
    kind: str
    error: float | None = None  #: error relative to ‖û‖, in the energy norm
    change: float | None = None  #: relative change ‖u_h − u_{h/2}‖/‖û‖ on the next mesh
    rate: float | None = None  #: observed rate q of the squared error
    #: for the kind "limit", the geometry to which the meshes converge; for other kinds,
    #: the reason why there is no limit
    note: str = ""
    #: levels; the first is the coarsest mesh, which is the mesh of the case
    levels: tuple[Level, ...] = ()
    #: values of all keys of the case
    params: Mapping[str, object] = field(default_factory=dict)

    def __str__(self) -> str:
        """Describe the error, or the reason why it is unknown."""
        if self.error is None:
            return f"unknown: {self.note}"
        before = {"limit": "about ", "rounding": "less than "}.get(self.kind, "")
        after = f" to the next finer mesh only: {self.note}" * (self.kind == "change")
        if self.kind == "limit" and self.note:
            after = f", {self.note}"
        return f"{before}{brief(self.error)}{after}"


def estimate_error(
    case: str, levels: Sequence[Level], singular: str = "", note: str = ""
) -> Discretisation:
    """Estimate the discretisation error on the first level.

    levels : at most three levels, coarsest mesh first
    singular : reason why the energy diverges under refinement; empty if it converges
    note : reason why there are no further levels
    """
    nothing = Discretisation(case=case, kind="unknown", note=note, levels=tuple(levels))
    if len(levels) < 2:
        return nothing
    norm = levels[0].norm or 1.0
    steps = [level.distance or 0.0 for level in levels[1:]]
    doubt = sum(max(level.bound, ROUNDING) * level.norm for level in levels)
    change = steps[0] / norm
    if steps[0] <= doubt:
        return replace(nothing, kind="rounding", error=doubt / norm, change=change)
    rate = 2 * log2(steps[0] / steps[1]) if min(steps) > doubt and steps[1:] else None
    found = replace(nothing, kind="change", error=change, change=change, rate=rate)
    if singular or rate is None:
        return replace(found, note=singular or note)
    if rate <= 0:
        return replace(
            found,
            note="the error does not decrease on these meshes: the second halving "
            f"changes u {2 ** (-rate / 2):.3g} times as much as the first",
        )
    if rate < MIN_RATE:
        return replace(
            found,
            note=f"the error decreases slowly on these meshes, like h^{rate / 2:.2f}",
        )
    return replace(found, kind="limit", error=change / sqrt(1 - 2**-rate))


def discretisation_errors(
    cases: Iterable[CaseId],
    reference: Reference,
    folder: Path,
    budget: float,
    tell: Callable[[str], None] = lambda _: None,
) -> list[Discretisation]:
    """Estimate the error of every physical case, and write ``folder/FILE``.

    If the time does not suffice for all meshes of a case, an earlier estimate from more
    meshes is kept.

    cases : cases to estimate; cases that differ only in form are estimated once
    folder : result folder, with the cache of reference points in ``references``
    budget : time for all cases, s; a mesh is skipped if its expected time exceeds the
        remaining time
    tell : progress callback, called with a message before each case
    """
    end, found = perf_counter() + budget, dict[str, Discretisation]()
    earlier: dict[str, Discretisation] = {}
    with suppress(InputError):  # a damaged file is replaced
        earlier = read_discretisation(folder)
    for case in cases:
        physical = case.name.removesuffix(f"/{case.form}")
        if physical not in found:
            tell(f"finer meshes of {physical}")
            left = _Halving(case.family, reference, folder / "references", end)
            levels = tuple(left.levels(case))
            new = estimate_error(physical, levels, case.family.singular, left.why)
            kept = case.family.unrefined(case.params) if new.error is not None else ""
            note = "; ".join(filter(None, [new.note, kept]))
            new = replace(new, params=case.params, note=note)
            old = earlier.get(physical, new)
            found[physical] = old if left.late and _continues(old, new) else new
    _write(folder / FILE, found.values())
    return list(found.values())


def read_discretisation(folder: Path) -> dict[str, Discretisation]:
    """Return the stored errors by physical case; {} if the file is missing.

    Raises
    ------
    InputError
        If the file is malformed.

    """
    path = folder / FILE
    if not path.exists():
        return {}
    try:
        data = read_json(path)
        if data["schema"] != SCHEMA:
            raise InputError(f"{path}: schema {data['schema']!r}; expected {SCHEMA}")
        rows = [
            Discretisation(**row | {"levels": tuple(Level(**x) for x in row["levels"])})
            for row in data["cases"]
        ]
    except (ValueError, TypeError, LookupError) as e:
        text = " ".join(str(e).split())
        raise InputError(f"{path}: malformed: {text}; validate the folder") from None
    return {row.case: row for row in rows}


def _continues(old: Discretisation, new: Discretisation) -> bool:
    """Return True if `old` contains all meshes of `new` and finer meshes."""
    common = [
        (a.case, a.unknowns) == (b.case, b.unknowns)
        for a, b in zip(old.levels, new.levels, strict=False)
    ]
    return (
        old.params == new.params and len(old.levels) > len(new.levels) and all(common)
    )


def _write(path: Path, found: Iterable[Discretisation]) -> None:
    """Write the errors to a file, which is replaced atomically."""
    data = {"schema": SCHEMA, "cases": [asdict(d) for d in found]}
    text = json.dumps(data, indent=1, allow_nan=False) + "\n"
    with report_full_disk(path.parent):
        replace_file(path, text.encode())


@dataclass(eq=False)
class _Halving:
    """Solutions of a case on meshes with successively halved cell size."""

    family: Family
    reference: Reference
    references: Path
    end: float  #: deadline on the clock `perf_counter`, in s
    why: str = ""  #: reason why there is no finer mesh
    late: bool = False  #: True if the reason is the deadline
    _coarse: tuple[Grid, Extended] | None = None

    def levels(self, case: CaseId) -> Iterator[Level]:
        """Yield the levels that fit the limits of size and time, coarsest first."""
        form = "primal" if "primal" in self.family.forms else case.form
        sizes: list[int] = []
        seconds = 0.0
        try:
            params = None if self.family.refined(case.params) is None else case.params
        except InputError as e:
            self.why = str(e)
            return
        while len(sizes) < MAX_LEVELS:
            if params is None:
                self.why = f"the family {self.family.name} offers no refined mesh"
                return
            growth = sizes[-1] / sizes[-2] if len(sizes) > 1 else GROWTH
            if sizes and self._refused(growth * sizes[-1]):
                return
            left = self.end - perf_counter()
            if not left > seconds * growth**TIME_EXPONENT:
                self.late = True
                self.why = "the next mesh would take more than the remaining time"
                return
            start = perf_counter()
            level = self._level(params, form, first=not sizes)
            if level is None and not sizes and form != case.form:
                # cases on subdomains have only a dual form
                form, self.why = (case.form, "")
                level = self._level(params, form, first=True)
            if level is None:
                return
            yield level
            sizes.append(level.unknowns)
            seconds = perf_counter() - start
            complete = assemble(self.family, params, form).params
            params = self.family.refined(complete)

    def _refused(self, size: float) -> bool:
        if size <= MAX_UNKNOWNS:
            return False
        self.why = (
            f"the next mesh would have about {size:,.0f} unknowns; at most "
            f"{MAX_UNKNOWNS:,} are solved"
        )
        return True

    def _level(
        self, params: Mapping[str, object], form: str, *, first: bool
    ) -> Level | None:
        """Solve on one mesh; on failure, set `why` and return None."""
        text = self.family.name
        try:
            case = assemble(self.family, params, form)
            text = case.name
            mechanics = case.build(self.reference).mechanics
            if mechanics is None:
                self.why = "the case has no elastic problem"
                return None
            if mechanics.grid is None:
                self.why = "the family does not provide the mesh"
                return None
            unknowns = mechanics.primal.q.size
            if first and self._refused(GROWTH * unknowns):
                return None  # without a second mesh, the solve is not needed
            point = reference_point(mechanics, self.reference, self.references)
            distance = self._distance(mechanics, mechanics.grid, point.u)
        except UnsolvedError as e:
            self.why = f"{text} has no reference solution: {e}"
            return None
        except NonNestedMeshError:
            self.why = (
                f"the mesh of {text} is not the coarser mesh with every cell halved"
            )
            return None
        except (Exception, SystemExit) as e:  # raised by code of the family
            self.why = unbuilt(text, e)
            return None
        root = sqrt(abs(mechanics.scale))
        return Level(
            case=text,
            unknowns=unknowns,
            energy=mechanics.energy(point.u),
            norm=point.norm * root,
            bound=point.bound,
            distance=None if distance is None else distance * root,
        )

    def _distance(self, mechanics: Mechanics, grid: Grid, u: Extended) -> float | None:
        """Return the energy norm of u − u_{2h}, or None on the first mesh; store u.

        The stored u is compared with the solution on the next mesh.
        """
        whole = u + grid.lift
        before, self._coarse = self._coarse, (grid, whole)
        if before is None:
            return None
        coarse, old = before
        shape = (len(coarse.points), -1)
        moved = prolongation(coarse, grid).astype(Real) @ old.reshape(shape)
        return mechanics.norm(whole - moved.ravel())
