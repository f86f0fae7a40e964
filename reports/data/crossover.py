"""Crossover of routes: time and memory from the mesh to a verified answer, by size.

A *route* is a form of the QP with its decomposition and number of ranks, solved by the
fastest of the measured solvers. The primal form with multigrid is a separate route.
The time includes all work from the mesh to the recovered displacements:

    build (mesh, assembly, contact rows, dualisation) + prepare + solve + recovery.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from mortarbench.harness import Record, Verdict
from mortarbench.harness.running.pairs import Ratio, ratio_of
from mortarbench.reports.data.evidence import SEVERITY, Evidence, Outcome
from mortarbench.reports.data.rank_series import base_label
from mortarbench.reports.data.size_series import SIZES, SeriesKey, fixed_keys
from mortarbench.reports.statistics.intervals import Interval, median_interval

MULTIGRID = "ipm-amg"  #: solver that forms a separate route
#: keys that choose a decomposition; they do not change the mesh
DECOMPOSITION = ("feti", "glue", "parts")
#: values of `Route.kind` in a complete map
KINDS = ("primal", "primal, multigrid", "dual", "dual-bounds", "TFETI")
PRIMAL = KINDS[:2]


class Route(NamedTuple):
    """Form, decomposition and number of ranks; `MULTIGRID` has a kind of its own."""

    kind: str  #: one of `KINDS`, or the name of another form
    layout: str  #: keys of the decomposition, "feti=16"; empty without decomposition
    ranks: int

    @property
    def label(self) -> str:
        """Name of the route; unique among routes."""
        name = f"{self.kind} ({self.layout})" if self.layout else self.kind
        return f"{name}, {self.ranks} ranks" if self.ranks > 1 else name


class Stop(NamedTuple):
    """First size above the largest verified size of a route, and its verdicts."""

    dofs: int | None  #: None if the largest size was verified
    #: mildest verdict among the solvers, DECLINED only if all declined; None if not run
    verdict: Verdict | None
    outcomes: tuple[Outcome, ...]  #: answers of all solvers at that size


@dataclass(frozen=True, eq=False, kw_only=True)
class Map:
    """Verified answers of the routes on one series of meshes, and their stops."""

    title: str
    sizes: tuple[int, ...]  #: dofs, ascending
    #: at each size, the answer of the fastest verified solver; by dofs
    routes: Mapping[Route, Mapping[int, Outcome]]
    stops: Mapping[Route, Stop]
    #: kinds of the routes that were left out because all solvers declined every case
    declined: frozenset[str] = frozenset()

    @property
    def missing(self) -> tuple[str, ...]:
        """Kinds that no route of the map has."""
        present = {route.kind for route in self.routes}
        return tuple(kind for kind in KINDS if kind not in present)

    def crossover(self, dual: Route, primal: Route) -> Crossover | None:
        """Compare a dual route with a primal one; None if they have no common size."""
        a, b = self.routes[dual], self.routes[primal]
        common = sorted(a.keys() & b.keys())
        if not common:
            return None
        ratios = {
            n: ratio_of(_by_block(b[n]), _by_block(a[n])) or _single(b[n], a[n])
            for n in common
        }
        pays = None
        for n in reversed([n for n in common if ratios[n].pairs > 1]):
            if ratios[n].low <= 1:
                break
            pays = n
        return Crossover(
            pays=pays,
            largest=common[-1],
            smallest=common[0],
            ratio=ratios[common[-1]],
            beyond=max(a) > max(b),
            answers=(a[common[-1]], b[common[-1]]),
        )


class Crossover(NamedTuple):
    """Comparison of two routes on the sizes that both reached."""

    #: smallest number of dofs such that the dual route is significantly faster at this
    #: and every larger common size with repeats; None if the dual route is not
    #: significantly faster at the largest of these sizes, or if there are none
    pays: int | None
    smallest: int  #: smallest number of dofs that both routes reached
    largest: int  #: largest number of dofs that both routes reached
    ratio: Ratio  #: time of the primal route relative to the dual one, at `largest`
    beyond: bool  #: True if the dual route reached larger sizes than the primal route
    answers: tuple[Outcome, Outcome]  #: answers of both routes at the size `largest`


def charged_seconds(r: Record) -> float | None:
    """Return the seconds from the mesh to the recovered answer; None if incomplete."""
    parts = (r.build_seconds, r.total_seconds, r.recover_seconds)
    return None if None in parts else sum(part or 0.0 for part in parts)


def charged(o: Outcome) -> Interval | None:
    """Return the median time from the mesh to the answer, s; None if incomplete."""
    times = [t for r in o.records if (t := charged_seconds(r)) is not None]
    return median_interval(times) if times else None


def memory(o: Outcome) -> Interval | None:
    """Return the median peak memory (MiB) of the solves, with its interval.

    On several ranks, the ranks build the case themselves, and the peak is the joint
    memory of all ranks. The value is None if no peak is known.
    """
    peaks = [r.peak_mib for r in o.records if r.peak_mib is not None]
    return median_interval(peaks) if peaks else None


def crossover_maps(evidence: Evidence) -> list[Map]:
    """Return a map for each series of three or more sizes in primal and dual forms."""
    answers = [o for o in evidence.flat if not o.first.arm and o.first.mode == "cold"]
    dofs = _dofs(answers)
    sized = [(n, o) for o in answers if (n := dofs.get(_mesh(o))) is not None]
    fixed = fixed_keys(sized, apart=DECOMPOSITION)
    series: dict[SeriesKey, list[tuple[int, Outcome]]] = {}
    for n, o in sized:
        r = o.first
        shared = tuple((k, r.params.get(k)) for k in fixed.get(r.family, ()))
        key = SeriesKey(r.family, shared, "", o.tol, "")
        series.setdefault(key, []).append((n, o))
    maps = (_map(key.title, of) for key, of in series.items())
    return [
        one
        for one in maps
        if len(one.sizes) >= SIZES
        and {route.kind in PRIMAL for route in one.routes} == {True, False}
    ]


def _map(title: str, sized: Sequence[tuple[int, Outcome]]) -> Map:
    by_route: dict[Route, dict[int, list[Outcome]]] = {}
    for n, o in sized:
        by_route.setdefault(_route(o), {}).setdefault(n, []).append(o)
    sizes = tuple(sorted({n for n, _ in sized}))
    routes, stops, declined = {}, {}, set()
    for route in sorted(by_route, key=_position):
        fastest = {
            n: min(ends, key=lambda end: end[0])[1]
            for n, of in sorted(by_route[route].items())
            if (ends := [(t.value, o) for o in of if o.verified and (t := charged(o))])
        }
        if not fastest and _inapplicable(by_route[route]):
            declined.add(route.kind)
            continue
        routes[route] = fastest
        stops[route] = _stop(sizes, by_route[route], fastest)
    return Map(
        title=title,
        sizes=sizes,
        routes=routes,
        stops=stops,
        declined=frozenset(declined),
    )


def _inapplicable(answers: Mapping[int, Iterable[Outcome]]) -> bool:
    """Return True if all solvers declined every case.

    This happens, for example, for undivided bodies on two ranks.
    """
    every = [o for of in answers.values() for o in of]
    return all(o.verdict is Verdict.DECLINED for o in every)


def _stop(
    sizes: Sequence[int],
    answers: Mapping[int, Sequence[Outcome]],
    fastest: Mapping[int, Outcome],
) -> Stop:
    last = max(fastest, default=0)
    beyond = next((n for n in sizes if n > last), None)
    if beyond is None:
        return Stop(None, None, ())
    ends = answers.get(beyond, ())
    # the worst verdict counts among repeats, but the mildest one among solvers
    verdict = max(
        (o.verdict for o in ends if not o.verified), key=SEVERITY.index, default=None
    )
    others = [v for o in ends if (v := o.verdict) is not Verdict.DECLINED]
    if verdict is Verdict.DECLINED and others:
        verdict = max(others, key=SEVERITY.index)
    return Stop(beyond, verdict, tuple(ends))


def _route(o: Outcome) -> Route:
    r = o.first
    keys = {k: r.params.get(k) for k in ("feti", "parts")}
    layout = ", ".join(f"{k}={v}" for k, v in keys.items() if v)
    if not layout:
        kind = r.form
        if kind == PRIMAL[0] and base_label(o) == MULTIGRID:
            kind = PRIMAL[1]
    else:
        kind = "TFETI"
    return Route(kind, layout, r.ranks)


def _position(route: Route) -> tuple[Any, ...]:
    known = KINDS.index(route.kind) if route.kind in KINDS else len(KINDS)
    return known, route.layout, route.ranks


def _mesh(o: Outcome) -> tuple[Any, ...]:
    """Return the family and the parameters except the keys of the decomposition."""
    params = {k: v for k, v in o.first.params.items() if k not in DECOMPOSITION}
    return o.first.family, *sorted(params.items())


def _dofs(answers: Iterable[Outcome]) -> dict[tuple[Any, ...], int]:
    """Return the number of dofs of each mesh, from an answer or from the primal QP."""
    dofs: dict[tuple[Any, ...], int] = {}
    for o in answers:
        n = o.size("dofs")
        if n is None and o.first.form == PRIMAL[0]:
            n = o.first.sizes.get("variables")
        if n:
            dofs.setdefault(_mesh(o), n)
    return dofs


def _by_block(o: Outcome) -> dict[tuple[str, int], float]:
    times = {(r.session, r.repeat): charged_seconds(r) for r in o.records}
    return {block: t for block, t in times.items() if t}


def _single(a: Outcome, b: Outcome) -> Ratio:
    """Return the ratio of the first runs, with the unbounded interval (0, ∞)."""
    (t, *_), (s, *_) = _by_block(a).values(), _by_block(b).values()
    return Ratio(t / s, 0.0, float("inf"), 1)
