"""Cross-validation of the answers in a result folder, and conformance of solvers."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mortarbench.harness import checked
from mortarbench.harness.errors import InputError, shown, some, unknown
from mortarbench.harness.files.durable import replace_file, report_full_disk
from mortarbench.harness.plugin import Solver
from mortarbench.harness.registry import SolverSpec, check_solver, resolve
from mortarbench.progress import ignore
from mortarbench.registries import Plugins, Registries, load_registries, one_thread
from mortarbench.text import align

if TYPE_CHECKING:
    from mortarbench.harness.conformance.conformance import Result
    from mortarbench.harness.processes.supervisor import WorkerProcess

TIME_LIMIT = 10.0  #: time limit for each check of the conformance suite, in s
MEMORY_LIMIT = 4096.0  #: memory limit for each check, in MiB
_MAX_ROWS = 12  #: largest number of rows of a table on the terminal


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Validation:
    """Result of a cross-validation."""

    agreed: bool  #: True if no claim is refuted
    data: Mapping[str, Any]  #: contents of validation.json
    pages: tuple[Path, ...]  #: files of the page on the validation

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        return dict(self.data)

    def __repr__(self) -> str:
        """Return the page without its rules, and with the first rows of each table."""
        from mortarbench.reports.document import Table
        from mortarbench.reports.validation import compose

        parts: list[str] = []
        for section in compose(self.data).sections[:-1]:
            for item in section.items:
                if isinstance(item, Table):
                    rows = [item.head, *item.rows[:_MAX_ROWS]]
                    table = align(rows, right=range(item.texts, len(item.head)))
                    more = len(item.rows) - _MAX_ROWS
                    parts.append(f"{section.title}\n{table}")
                    parts += [f"… and {more} more, see the page"] * (more > 0)
                elif isinstance(item, str):
                    parts.append(item)
        return "\n\n".join(parts)


def validate(
    folder: Annotated[str | Path, "DIR"],
    *,
    budget: Annotated[float, "SECONDS"] = inf,
    plugins: Plugins = (),
    progress: Callable[[str], None] = ignore,
    registries: Registries | None = None,
) -> Validation:
    """Cross-validate the stored answers of a result folder on newly built cases.

    The results are written to validation.json and to the page report/validation.html.

    Parameters
    ----------
    folder : result folder of `run`
    budget : time in s after which no further case is begun; default: no limit
    plugins : Python files with more solvers or families
    progress : called with messages about the progress
    registries : used instead of built-in registries, installed plug-ins and `plugins`

    Raises
    ------
    InputError
        If the folder contains no answer that can be validated.

    Examples
    --------
    >>> import mortarbench as mb
    >>> results = mb.run("smoke", out="out/smoke", cases=["*/dual"], solvers=["pdas"])
    >>> mb.validate("out/smoke").agreed
    True

    """
    path = checked.result_folder("folder", folder)
    if not checked.is_number(budget) or not budget >= 0:  # `not ≥` also rejects NaN
        raise InputError(f"budget = {shown(budget)}; expected a number of seconds ≥ 0")
    registries = load_registries(plugins, registries)
    from mortarbench.harness.crossval.validation import validate_folder
    from mortarbench.reports.validation import summary, write_validation

    families, reference = registries.families, registries.reference
    with one_thread():
        result = validate_folder(path, families, reference, progress, budget)
    data = summary(result, path.resolve().name)
    text = json.dumps(data, allow_nan=False) + "\n"
    with report_full_disk(path):
        replace_file(path / "validation.json", text.encode())
    pages = tuple(write_validation(path, data))
    return Validation(agreed=data["agreed"], data=data, pages=pages)


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Conformance:
    """Results of the conformance suite for one solver."""

    solver: str  #: name of the solver, or of its class if it is an object
    results: Mapping[str, Result]  #: results by the name of the check

    @property
    def conforms(self) -> bool:
        """True if no check fails and the solver solves at least one QP."""
        return not self.objection

    @property
    def objection(self) -> str:
        """Reason why the solver does not conform, or "" if it conforms."""
        from mortarbench.harness.conformance.conformance import SOLUTION_PREFIX, Grade

        if self.failed:
            return f"fails {some(map(repr, self.failed))}"
        if not any(
            r.grade is Grade.PASS and name.startswith(SOLUTION_PREFIX)
            for name, r in self.results.items()
        ):
            return f"passes no check {SOLUTION_PREFIX!r}: it solved no QP"
        return ""

    @property
    def failed(self) -> Mapping[str, str]:
        """Messages of the failed checks, by name of the check."""
        return {n: r.message for n, r in self.results.items() if r.grade == "fail"}

    def to_dict(self) -> dict[str, Any]:
        """Return plain data; ``test-solver --json`` prints the entry `checks`."""
        checks = [
            dict(solver=self.solver, check=name, **r._asdict())
            for name, r in self.results.items()
        ]
        return {"solver": self.solver, "conforms": self.conforms, "checks": checks}

    def to_markdown(self) -> str:
        """Return a list of the failed checks and the weaknesses."""
        lines = [
            f"- {r.grade}: {name}: {r.message}"
            for name, r in self.results.items()
            if r.grade in ("weak", "fail")
        ]
        return "\n".join([f"## {self.solver}", "", *lines])

    def __repr__(self) -> str:
        from mortarbench.harness.conformance.conformance import Grade

        grades = Counter(r.grade for r in self.results.values())
        counts = ", ".join(f"{grades[g]} {g}" for g in Grade)
        rows = [(r.grade, name, r.message) for name, r in self.results.items()]
        return f"{align(rows)}\n{self.solver}: {counts}"


def test_solver(
    solver: str | Solver,
    *,
    plugins: Plugins = (),  # noqa: PT028  # not a test
    checks: Iterable[str] | None = None,  # noqa: PT028
    time_limit: Annotated[float, "SECONDS"] = TIME_LIMIT,  # noqa: PT028
    progress: Callable[[str], None] = ignore,  # noqa: PT028
    registries: Registries | None = None,  # noqa: PT028
) -> Conformance:
    """Run the conformance suite on a solver, in a separate process.

    If the process ends or exceeds the time limit during a check, the check fails or,
    for a reformulated QP, counts as a weakness; the remaining checks are run in a new
    process.

    Parameters
    ----------
    solver : a name listed by `solvers`, or an object as for `mortarbench.solve`
    plugins : Python files with more solvers
    checks : names of the checks to run; None for all
    time_limit : limit for each check in s
    progress : called before each check with its number and name
    registries : used instead of built-in registries, installed plug-ins and `plugins`

    Raises
    ------
    InputError
        If there is no such solver or check, or the solver cannot be copied.

    Examples
    --------
    >>> import mortarbench as mb
    >>> mb.test_solver("pdas", checks=["solves a sequence"]).failed
    {}

    """
    if not isinstance(solver, str):
        with checked.located("solver"):
            check_solver(solver)
    checked.positive("time_limit", time_limit)
    registries = load_registries(plugins) if registries is None else registries
    name = solver if isinstance(solver, str) else type(solver).__name__
    spec = SolverSpec(name=name, label=name)
    if isinstance(solver, str):
        resolve(spec, registries.solvers)
    from mortarbench.harness.conformance.conformance import CHECKS
    from mortarbench.harness.processes.scratch import single_worker

    names = list(CHECKS if checks is None else checks)
    for check in names:
        if check not in CHECKS:
            raise unknown("check", str(check), CHECKS)
    copied = None if isinstance(solver, str) else solver
    with single_worker(partial(registries.worker_command, spec), copied) as worker:
        results = {}
        for number, check in enumerate(names, start=1):
            progress(f"{name}: check {number} of {len(names)}, {check}")
            results[check] = _run_check(worker, check, time_limit)
    return Conformance(solver=name, results=results)


def _run_check(worker: WorkerProcess, check: str, time_limit: float) -> Result:
    """Run one check; without a reply of the solver's process, return a failure.

    For a check of an equivalent formulation, a weakness is returned instead.
    """
    from mortarbench.harness.conformance.conformance import (
        INVARIANCE_PREFIX,
        Grade,
        Result,
    )

    reply = worker.ask(
        {"check": check}, time_limit=time_limit, memory_limit=MEMORY_LIMIT
    )
    if reply.answer is None:
        is_weakness = check.startswith(INVARIANCE_PREFIX)
        return Result(Grade.WEAK if is_weakness else Grade.FAIL, reply.message)
    grade, *others = (reply.answer[field] for field in Result._fields)
    return Result(Grade(grade), *others)
