"""Repetition of a stored measurement, and comparison of the old and the new result."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING, Annotated, Any

from msgspec import structs

from mortarbench.harness import checked
from mortarbench.harness.environment.environment import digest
from mortarbench.harness.errors import FaultError, InputError
from mortarbench.harness.record import Record, finite
from mortarbench.harness.results.folder import differences, same_machine
from mortarbench.registries import TURN, Plugins, Registries, load_registries
from mortarbench.text import align

if TYPE_CHECKING:
    from mortarbench.harness.files.store import Arrays
    from mortarbench.harness.results.stored_run import StoredRun
    from mortarbench.harness.results.work_unit import Result

_RESIDUALS = ("primal", "dual", "complementarity", "gap")
_SECONDS = ("prepare_seconds", "solve_seconds", "total_seconds")
_VALUE_LENGTH = 48  #: maximum displayed length of a value of the environment


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Replay:
    """Stored measurement and its repetition."""

    then: Record  #: stored measurement
    now: Record  #: its repetition
    #: True if the QPs are equal; None if the old record has no digest of its QP
    same_qp: bool | None
    same_options: bool  #: True if all options are equal, including default values
    same_counts: bool  #: True if the iterations and all counts are equal
    #: ‖x_now − x_then‖∞ / ‖x_then‖∞ of the two points x; None if a point is missing
    distance: float | None
    ratios: Mapping[str, tuple[float, float, float] | None]
    """New time, smallest stored time and largest stored time, each divided by the
    median of the stored repeats. None if a time was not measured, or if it was measured
    on another machine.
    """
    stored: Mapping[str, tuple[float, ...]]  #: times of the stored repeats, in s
    same_machine: bool  #: True if machine and threads are equal
    #: differences of the environments: dotted key, old value, new value
    environment: list[tuple[str, Any, Any]]

    @property
    def reproduced(self) -> bool:
        """True if the verdicts are equal and the QPs are not known to differ."""
        return self.same_qp is not False and self.then.status is self.now.status

    def __repr__(self) -> str:
        return render(self)

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison as plain data for JSON."""
        lines = {"then": structs.asdict(self.then), "now": structs.asdict(self.now)}
        data: dict[str, Any] = finite(
            {**asdict(self), **lines, "reproduced": self.reproduced}
        )
        data["environment"] = [
            {"key": key, "then": then, "now": now}
            for key, then, now in self.environment
        ]
        return data


@TURN
def replay(
    folder: Annotated[str | Path, "DIR"],
    run_id: Annotated[str, "RUN_ID"],
    *,
    plugins: Plugins = (),
    registries: Registries | None = None,
) -> Replay:
    """Repeat one stored measurement, and compare it with the old one.

    Parameters
    ----------
    folder : result folder of `run`
    run_id : run_id of a line of the journal, or SESSION-RUN_ID, or the first digits; an
        HTML report shows it when the mouse points at a number
    plugins : Python files with more solvers or families
    registries : used instead of built-in registries, installed plug-ins and `plugins`

    Raises
    ------
    InputError
        If there is no such measurement, its case or solver is unknown, or the case
        cannot be built.
    FaultError
        If something other than the solver prevents the measurement.

    Examples
    --------
    >>> import mortarbench as mb
    >>> results = mb.run("smoke", out="out/smoke", cases=["*/dual"], solvers=["pdas"])
    >>> mb.replay("out/smoke", results.df.run_id[0]).reproduced
    True

    """
    registries = load_registries(plugins, registries)
    run_id = checked.text("run_id", run_id)
    path, solvers = checked.result_folder("folder", folder), registries.solvers
    from mortarbench.harness.results.stored_run import open_stored_run, work_unit_of
    from mortarbench.harness.results.work_unit import BuildFailure, MeasurementFault
    from mortarbench.harness.running.executor import execute

    stored = open_stored_run(path, run_id, registries.families, solvers)
    environment = registries.environment()
    unit = work_unit_of(stored, solvers, digest(environment))
    commands = registries.commands([stored.spec])
    with TemporaryDirectory(prefix="mortarbench-") as scratch:
        at = Path(scratch)
        *_, result = execute(
            iter([unit]),
            commands,
            at,
            at / "cases",
            operators=registries.operators,
        )
    if isinstance(result, BuildFailure):
        raise InputError(f"{stored.record.identity}: {result.reason}")
    if isinstance(result, MeasurementFault):
        raise FaultError(f"{stored.record.identity}: {result.reason}")
    return compare(path, stored, result, environment)


def compare(
    folder: Path,
    run: StoredRun,
    result: Result,
    environment: Mapping[str, Any],
) -> Replay:
    """Compare a new measurement and its solution with the ones stored in `folder`.

    run : stored measurement, with the other repeats of the same measurement
    environment : environment of the new measurement
    """
    then, now = run.record, result.record
    is_same = same_machine(run.environment, environment)
    stored = {
        name: tuple(s for r in run.repeats if (s := getattr(r, name)) is not None)
        for name in _SECONDS
    }
    return Replay(
        then=then,
        now=now,
        same_qp=None if then.qp is None else then.qp == now.qp,
        same_options=then.options == now.options,
        same_counts=(then.iterations, then.counts) == (now.iterations, now.counts),
        distance=_distance(folder, then, result.point),
        ratios={
            name: _ratio(stored[name], getattr(now, name)) if is_same else None
            for name in _SECONDS
        },
        stored=stored,
        same_machine=is_same,
        environment=list(
            differences(
                _pools_by_library(run.environment), _pools_by_library(environment)
            )
        ),
    )


def render(c: Replay) -> str:
    """Return a comparison as text: a table of old and new values, and a conclusion."""
    rows = [["", "then", "now", ""], *_verdicts(c), *_numbers(c), *_times(c)]
    lines = [f"{c.now.run_id}  {c.now.solver} on {c.now.case}, tolerance {c.now.tol:g}"]
    lines += ["", align(rows), ""]
    if c.environment:
        lines.append("The environment differs:")
        shown = [[f"  {k}", _short(a), f"→ {_short(b)}"] for k, a, b in c.environment]
        lines += [align(shown), ""]
    else:
        lines += ["The environment is the same.", ""]
    if c.reproduced:
        lines.append("Reproduced: the same verdict.")
    elif c.same_qp is False:
        lines.append("Not reproduced: the case now has a different QP.")
    else:
        lines.append(f"Not reproduced: {c.then.status} then, {c.now.status} now.")
    return "\n".join(lines)


def _verdicts(c: Replay) -> Iterable[list[str]]:
    then, now = c.then, c.now
    yield ["status", then.status, now.status, _same(then.status is now.status)]
    yield [
        "claimed",
        _text(then.claimed),
        _text(now.claimed),
        _same(then.claimed == now.claimed),
    ]
    if then.message or now.message:
        yield [
            "message",
            _short(then.message),
            _short(now.message),
            _same(then.message == now.message),
        ]
    verdict = "not recorded" if c.same_qp is None else _same(c.same_qp)
    yield ["QP", _text(then.qp), _text(now.qp), verdict]
    yield ["options", "", "", _same(c.same_options)]


def _numbers(c: Replay) -> Iterable[list[str]]:
    for name in ("iterations", *sorted({*c.then.counts, *c.now.counts})):
        a, b = (
            r.iterations if name == "iterations" else r.counts.get(name)
            for r in (c.then, c.now)
        )
        if (a, b) != (None, None):
            yield [name, _text(a), _text(b), _same(a == b)]
    for name in (*_RESIDUALS, "objective"):
        a, b = getattr(c.then, name), getattr(c.now, name)
        if (a, b) != (None, None):
            digits = ".10g" if name == "objective" else ".2g"
            yield [name, _text(a, digits), _text(b, digits), _same(a == b)]
    if c.distance is not None:
        yield ["point", "", "", _same(c.distance == 0) + f": off by {c.distance:.1e}"]


def _times(c: Replay) -> Iterable[list[str]]:
    for name, ratio in c.ratios.items():
        a, b = getattr(c.then, name), getattr(c.now, name)
        if ratio is None and (c.same_machine or None in (a, b)):
            continue
        row = _ratio_text(ratio, c.stored[name]) if ratio else "other machine"
        yield [
            name.removesuffix("_seconds") + ", s",
            _text(a, ".3g"),
            _text(b, ".3g"),
            row,
        ]


def _ratio_text(ratio: tuple[float, float, float], stored: Sequence[float]) -> str:
    """Return a ratio as text that states its denominator, the stored median.

    ratio : see `Replay.ratios`
    stored : times of the stored repeats, in s
    """
    now, least, greatest = ratio
    if len(stored) == 1:
        return f"{now:.2f} of the only stored repeat"
    return (
        f"{now:.2f} of {median(stored):.3g}, the median of {len(stored)} stored "
        f"repeats ({least:.2f} … {greatest:.2f} of the median)"
    )


def _distance(folder: Path, then: Record, point: Arrays | None) -> float | None:
    import numpy as np

    from mortarbench.harness.files.store import digest_of, load_solution, point_arrays
    from mortarbench.harness.solution import Status

    if then.vectors is None or point is None:
        return None
    try:
        solution = load_solution(folder, then.vectors, Status.SOLVED)
    except InputError:  # users may delete stored solutions; the journal remains valid
        return None
    if digest_of(point_arrays(solution)) != then.vectors:  # the file was changed
        return None
    stored = solution.x
    if stored.shape != point["x"].shape:
        return None
    scale = np.abs(stored).max(initial=0.0) or 1.0
    return float(np.abs(point["x"] - stored).max(initial=0.0) / scale)


def _ratio(
    stored: Sequence[float], new: float | None
) -> tuple[float, float, float] | None:
    if new is None or not stored or not (middle := median(stored)):
        return None
    return new / middle, min(stored) / middle, max(stored) / middle


def _pools_by_library(environment: Mapping[str, Any]) -> dict[str, Any]:
    """Return the environment with its list of thread pools as a mapping.

    The keys are names of libraries, so that differences are reported by library and not
    by position in the list.
    """
    threads = environment.get("threads")
    if not isinstance(threads, Mapping):
        return dict(environment)
    pools = threads.get("pools")
    if not isinstance(pools, list) or not all(isinstance(p, Mapping) for p in pools):
        return dict(environment)
    by_library = {f"{p.get('library')} of {p.get('owner')}": p for p in pools}
    return {**environment, "threads": {**threads, "pools": by_library}}


def _same(yes: bool) -> str:
    return "same" if yes else "differs"


def _text(value: Any, digits: str = "") -> str:
    return "–" if value is None else format(value, digits)


def _short(value: Any) -> str:
    text = _text(value) if isinstance(value, str | None) else str(value)
    return text if len(text) <= _VALUE_LENGTH else text[: _VALUE_LENGTH - 1] + "…"
