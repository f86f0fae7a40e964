"""Repetition of a stored measurement, and comparison of the old and the new record."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from msgspec import structs

from mortarbench.answer import solve
from mortarbench.case import Case
from mortarbench.harness import checked
from mortarbench.harness.errors import InputError, shortened
from mortarbench.harness.record import Record, finite
from mortarbench.harness.registry import SolverSpec, options_of, resolve
from mortarbench.registries import TURN, Plugins, Registries, load_registries
from mortarbench.text import align

#: fields of records that are compared
_COMPARED = (
    "status", "claimed", "message", "qp", "iterations", "options", "counts", "primal",
    "dual", "complementarity", "gap", "objective", "prepare_seconds", "solve_seconds",
)  # fmt: skip
_VALUE_LENGTH = 48  #: maximum displayed length of a value


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Replay:
    """Stored measurement and its repetition."""

    then: Record  #: stored measurement
    now: Record  #: its repetition
    #: differences of the environments: dotted key, old value, new value
    environment: list[tuple[str, Any, Any]]

    @property
    def same_qp(self) -> bool:
        """True if the QPs are not known to differ."""
        return None in (self.then.qp, self.now.qp) or self.then.qp == self.now.qp

    @property
    def reproduced(self) -> bool:
        """True if the verdicts are equal and the QPs are not known to differ."""
        return self.same_qp and self.then.status is self.now.status

    def __repr__(self) -> str:
        """Return a table of old and new values, and a conclusion."""
        r, rows = self.now, [["", "then", "now", ""]]
        for name in _COMPARED:
            a, b = getattr(self.then, name), getattr(r, name)
            same = "same" if a == b else "differs"
            if not (a is b is None or a == b == ""):
                remark = "" if name.endswith("seconds") else same
                rows.append([name, _text(a), _text(b), remark])
        rows += [[k, _text(a), _text(b), "differs"] for k, a, b in self.environment]
        end = "Reproduced: the same verdict."
        if not self.same_qp:
            end = "Not reproduced: the case now has a different QP."
        elif not self.reproduced:
            end = f"Not reproduced: {self.then.status} then, {r.status} now."
        head = f"{r.run_id}  {r.solver} on {r.case}, tolerance {r.tol:g}"
        return f"{head}\n\n{align(rows)}\n\n{end}"

    def to_dict(self) -> dict[str, Any]:
        """Return the comparison as plain data for JSON."""
        data: dict[str, Any] = finite(
            {
                "then": structs.asdict(self.then),
                "now": structs.asdict(self.now),
                "same_qp": self.same_qp,
                "reproduced": self.reproduced,
                "environment": [
                    {"key": key, "then": then, "now": now}
                    for key, then, now in self.environment
                ],
            }
        )
        return data


@TURN
def replay(
    folder: Annotated[str | Path, "DIR"],
    run_id: Annotated[str, "RUN_ID"],
    *,
    plugins: Plugins = (),
    registries: Registries | None = None,
) -> Replay:
    """Solve the case of a stored measurement again, and compare the records.

    A step of a sequence is solved without the earlier steps.

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
    path = checked.result_folder("folder", folder)
    from mortarbench.harness.results.folder import differences, environment_of
    from mortarbench.harness.results.journal import read_journal
    from mortarbench.harness.results.stored_run import (
        case_of,
        find_record,
        plugins_needed,
    )
    from mortarbench.harness.suite.suite import read_suite
    from mortarbench.harness.verify.verdicts import judged

    then = find_record(path, run_id, read_journal(path))
    environment = environment_of(path, then.environment)
    try:
        answer = solve(
            Case(id=case_of(then, registries.families), registries=registries),
            then.method,
            then.tol,
            options=_changed_options(then, registries),
            ranks=then.ranks,
            time_limit=read_suite(path / "suite.toml").time_limit,
        )
    except InputError as e:
        needed = plugins_needed(environment) if "unknown" in str(e) else ""
        raise InputError(f"{then.run_id}: {e}{needed}") from None
    same = {name: getattr(then, name) for name in ("run_id", "solver", "accuracy")}
    now = answer.record.replace(**same)
    if then.accuracy is not None and answer.solution is not None:
        now = judged(now, answer.case.qp, answer.solution)
    return Replay(
        then=then,
        now=now,
        environment=list(differences(environment, registries.environment())),
    )


def _changed_options(r: Record, registries: Registries) -> Mapping[str, Any]:
    """Return the options of a record that differ from today's defaults."""
    from mortarbench.harness.verify.verdicts import plain

    default = SolverSpec(name=r.method, label=r.method)
    today = plain(options_of(resolve(default, registries.solvers)))
    return {
        k: v for k, v in r.options.items() if today.get(k, ...) != v or k == "history"
    }


def _text(value: Any) -> str:
    text = f"{value:.10g}" if isinstance(value, float) else str(value)
    return "–" if value is None else shortened(text, _VALUE_LENGTH)
