"""How far the solution on a mesh is from that of the continuum: what accuracy is worth.

Meshes whose cells are halved in turn have the solutions u_h, u_{h/2}, u_{h/4}. Their
distances in the energy norm, u_h interpolated on the finer mesh, tell how fast they
converge and what is left (Richardson's extrapolation of squares):

    2^q = ‖u_h − u_{h/2}‖² / ‖u_{h/2} − u_{h/4}‖²
    ‖u_h − u‖² = ‖u_h − u_{h/2}‖² / (1 − 2^−q)                                       (1)

with q = 2 for linear and bilinear elements where u is smooth. (1) is Galerkin's
orthogonality, which holds without contact in spaces that contain each other; contact
adds the work of its pressure on the gaps between the solutions, which is of higher
order if few nodes change. Estimates are relative to ‖û‖, the norm that
`harness.verify.certificate` divides by, so that both can be compared.

Energies would be simpler, ‖u_h − u‖² ≤ 2(J_h − J), but they also move, at the same
order in h, with what is no error of u: a curved side is another polygon on every mesh,
and so are boundary values. On the membrane they give 1.5 times the true error, on a
cylinder with four cells per a an eighth of it. Load steps are linearised at the
solution of each mesh, which is an error of the mesh like others. Under a point load
there is no limit: the energy falls like log h, and what is left to say is how far the
next mesh is.
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
from mortarbench.harness.crossval.mesh_refinement import prolongation
from mortarbench.harness.errors import InputError
from mortarbench.harness.files.durable import full_disk_told, replace_file
from mortarbench.harness.files.reading import read_json
from mortarbench.harness.mechanics import Extended, Grid, Mechanics, Real
from mortarbench.harness.names import CaseId, assemble, unbuilt
from mortarbench.harness.plugin import Family, Reference
from mortarbench.harness.verify.references import UnsolvedError, reference_point

FILE = "discretisation.json"  #: in the result folder
SCHEMA = 1
MOST_UNKNOWNS = 200_000  #: of a mesh that is solved
GROWTH = 4.0  #: of the unknowns by halving, until it is known better
POWER = 1.5  #: of the unknowns that the time of a reference solve grows like
LEVELS = 3  #: two halvings, where they are affordable
SLOWEST = 0.5  #: q below which nothing is extrapolated
ROUNDING = 1e-8  #: of u: slender bodies in doubles, where certificates say less


@dataclass(frozen=True, kw_only=True)
class Level:
    """The solution on one mesh; plain data."""

    case: str  #: canonical name
    unknowns: int
    energy: float  #: J_h, J/m or what the family calls energy
    norm: float  #: ‖û‖, in √energy
    bound: float  #: certified relative error of the reference solution
    distance: float | None = None  #: to the solution on the level before, in √energy


@dataclass(frozen=True, kw_only=True)
class Discretisation:
    """What the meshes say of one physical case; plain data.

    kind : "limit", `error` is that against the limit of fine meshes; "change", it is
        the difference from the next mesh; "rounding", it is less than `error`, which is
        what rounding hides; "unknown", there is none, see `note`
    """

    case: str  #: canonical name without the form
    kind: str
    error: float | None = None  #: relative to ‖û‖, energy norm
    change: float | None = None  #: ‖u_h − u_{h/2}‖/‖û‖
    rate: float | None = None  #: q of the squared error, observed
    note: str = ""  #: why there is no more than that; of a limit, of which geometry
    levels: tuple[Level, ...] = ()  #: coarsest first, that is the case itself
    params: Mapping[str, object] = field(default_factory=dict)  #: of the case, all

    def __str__(self) -> str:
        """Put the error in words, or the reason why it is not known."""
        if self.error is None:
            return f"unknown: {self.note}"
        before = {"limit": "about ", "rounding": "less than "}.get(self.kind, "")
        after = f" to the next finer mesh only: {self.note}" * (self.kind == "change")
        if self.kind == "limit" and self.note:
            after = f", {self.note}"
        return f"{before}{brief(self.error)}{after}"


def estimated(
    case: str, levels: Sequence[Level], singular: str = "", note: str = ""
) -> Discretisation:
    """Estimate the error of the first of one to three levels.

    singular : why energies have no limit, where they have none
    note : why there are no more levels
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
            found, note="it does not fall on these meshes: the next halving changes "
            f"{2 ** (-rate / 2):.3g} times as much",
        )  # fmt: skip
    if rate < SLOWEST:
        return replace(
            found, note=f"it falls slowly on these meshes, like h^{rate / 2:.2f}"
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

    What the file says already stays where there was less time than there was then.

    cases : forms of one physical case count once
    folder : the result folder; its ``references`` keep what was solved
    budget : seconds; a mesh that would take longer than what is left is not begun
    tell : is told of each case that begins
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
            new = estimated(physical, levels, case.family.singular, left.why)
            kept = case.family.unrefined(case.params) if new.error is not None else ""
            note = "; ".join(filter(None, [new.note, kept]))
            new = replace(new, params=case.params, note=note)
            old = earlier.get(physical, new)
            found[physical] = old if left.late and _continues(old, new) else new
    _write(folder / FILE, found.values())
    return list(found.values())


def read_discretisation(folder: Path) -> dict[str, Discretisation]:
    """Read what `discretisation_errors` wrote, by physical case; empty without a file.

    Raises
    ------
    InputError
        When the file is malformed.

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
    """Whether `old` has the meshes of `new` and finer ones."""
    common = [
        (a.case, a.unknowns) == (b.case, b.unknowns)
        for a, b in zip(old.levels, new.levels, strict=False)
    ]
    return (
        old.params == new.params and len(old.levels) > len(new.levels) and all(common)
    )


def _write(path: Path, found: Iterable[Discretisation]) -> None:
    """Replace the file as a whole."""
    data = {"schema": SCHEMA, "cases": [asdict(d) for d in found]}
    text = json.dumps(data, indent=1, allow_nan=False) + "\n"
    with full_disk_told(path.parent):
        replace_file(path, text.encode())


@dataclass(eq=False)
class _Halving:
    """Solves a case on finer and finer meshes, and remembers why it stopped."""

    family: Family
    reference: Reference
    references: Path
    end: float
    why: str = ""
    late: bool = False  #: stopped for lack of time
    _coarse: tuple[Grid, Extended] | None = None

    def levels(self, case: CaseId) -> Iterator[Level]:
        """Yield the levels that can be afforded, coarsest first."""
        form = "primal" if "primal" in self.family.forms else case.form
        sizes: list[int] = []
        seconds = 0.0
        try:
            params = None if self.family.refined(case.params) is None else case.params
        except InputError as e:
            self.why = str(e)
            return
        while len(sizes) < LEVELS:
            if params is None:
                self.why = f"the family {self.family.name} offers no refined mesh"
                return
            growth = sizes[-1] / sizes[-2] if len(sizes) > 1 else GROWTH
            if sizes and self._refused(growth * sizes[-1]):
                return
            left = self.end - perf_counter()
            if not left > seconds * growth**POWER:
                self.late = True
                self.why = "the next mesh would take more time than was left"
                return
            start = perf_counter()
            level = self._level(params, form, first=not sizes)
            if level is None and not sizes and form != case.form:
                form, self.why = case.form, ""  # subdomains have a dual only
                level = self._level(params, form, first=True)
            if level is None:
                return
            yield level
            sizes.append(level.unknowns)
            seconds = perf_counter() - start
            complete = assemble(self.family, params, form).params
            params = self.family.refined(complete)

    def _refused(self, size: float) -> bool:
        if size <= MOST_UNKNOWNS:
            return False
        self.why = (
            f"the next mesh would have about {size:,.0f} unknowns; at most "
            f"{MOST_UNKNOWNS:,} are solved"
        )
        return True

    def _level(
        self, params: Mapping[str, object], form: str, *, first: bool
    ) -> Level | None:
        """Solve one mesh; None, with the reason, where that is impossible."""
        text = self.family.name
        try:
            case = assemble(self.family, params, form)
            text = case.name
            mechanics = case.build(self.reference).mechanics
            if mechanics is None:
                self.why = "there is no elastic problem behind it"
                return None
            if mechanics.grid is None:
                self.why = "its family does not say what its mesh is"
                return None
            unknowns = mechanics.primal.q.size
            if first and self._refused(GROWTH * unknowns):
                return None  # before it is solved
            point = reference_point(mechanics, self.reference, self.references)
            distance = self._distance(mechanics, mechanics.grid, point.u)
        except UnsolvedError as e:
            self.why = f"{text} has no reference solution: {e}"
            return None
        except (Exception, SystemExit) as e:  # the family's code
            self.why = unbuilt(text, e)
            return None
        root = sqrt(abs(mechanics.scale))
        return Level(
            case=text, unknowns=unknowns, energy=mechanics.energy(point.u),
            norm=point.norm * root, bound=point.bound,
            distance=None if distance is None else distance * root,
        )  # fmt: skip

    def _distance(self, mechanics: Mechanics, grid: Grid, u: Extended) -> float | None:
        """Return ‖u − u_{2h}‖ on this mesh, and keep u for the next one."""
        whole = u + grid.lift
        before, self._coarse = self._coarse, (grid, whole)
        if before is None:
            return None
        coarse, old = before
        shape = (len(coarse.points), -1)
        moved = prolongation(coarse, grid).astype(Real) @ old.reshape(shape)
        return mechanics.norm(whole - moved.ravel())
