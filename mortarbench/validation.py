"""Cross-validation of the answers in a result folder, and conformance of a solver."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack, suppress
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from typing import Any

from mortarbench.arguments import budget as checked_budget
from mortarbench.harness import checked
from mortarbench.harness.conformance.conformance import (
    CHECKS,
    FINDS,
    KEEPS,
    Grade,
    Result,
)
from mortarbench.harness.crossval.comparison import brief
from mortarbench.harness.crossval.discretisation import (
    Discretisation,
    discretisation_errors,
)
from mortarbench.harness.crossval.summary import as_data
from mortarbench.harness.crossval.validation import validate_folder
from mortarbench.harness.errors import InputError, some, unknown
from mortarbench.harness.files.durable import replace_file, report_full_disk
from mortarbench.harness.names import CaseId, assemble
from mortarbench.harness.plugin import Solver
from mortarbench.harness.processes.measurement import scratch_folder
from mortarbench.harness.processes.solver_file import write_solver
from mortarbench.harness.processes.supervisor import WorkerProcess
from mortarbench.harness.registry import SolverSpec, check_solver, resolve
from mortarbench.harness.results.journal import read_journal
from mortarbench.progress import ignore
from mortarbench.registries import Plugins, Registries, known, one_thread
from mortarbench.text import aligned, legible

OURS = "smalbe"  #: the solver that every other one is set against
TIME_LIMIT = 60.0  #: s per check of the conformance suite
MEMORY_LIMIT = 4096.0  #: MiB per check
_MOST = 12  #: entries of a list on the terminal; the page has them all


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Validation:
    """What a cross-validation found."""

    agreed: bool  #: no claim is refuted, and no two answers disagree
    data: Mapping[str, Any]  #: everything, as in validation.json
    meshes: tuple[Discretisation, ...]  #: what finer meshes told
    pages: tuple[Path, ...]

    def to_dict(self) -> dict[str, Any]:
        """Plain data for JSON, without what concerns single problems."""
        verdict = {k: v for k, v in self.data.items() if k != "problems"}
        return {**verdict, "discretisation": [asdict(d) for d in self.meshes]}

    def __repr__(self) -> str:
        return as_text(self.data, self.meshes)

    def _repr_html_(self) -> str:
        return f"<pre>{escape(repr(self))}</pre>"


@one_thread()
def validate(
    folder: str | Path,
    *,
    budget: float = 300.0,
    plugins: Plugins = (),
    progress: Callable[[str], None] = ignore,
    registries: Registries | None = None,
) -> Validation:
    """Build every case of a result folder again, and judge every stored answer.

    Writes validation.json and the page report/validation.html.

    Parameters
    ----------
    budget : s, for finer meshes, which tell discretisation errors
    plugins : Python files with more solvers or families
    progress : is told what happens
    registries : what is known, instead of ours, what is installed and `plugins`

    Raises
    ------
    InputError
        When the folder holds no answer that can be judged.

    """
    path = checked.path("folder", folder)
    checked_budget(budget)
    checked.function("progress", progress)
    registries = known(plugins, registries)
    families = registries.families_with_copies(path)
    found = validate_folder(path, families, registries.reference, progress)
    data = as_data(found, path.resolve().name, ours=OURS)
    if not (data["counts"]["answers"] or found.false_claims or found.proven):
        why = found.not_validated[0].text if found.not_validated else "none is a claim"
        raise InputError(f"{path}: no stored answer can be judged: {why}")
    text = json.dumps(data, allow_nan=False) + "\n"
    with report_full_disk(path):
        replace_file(path / "validation.json", text.encode())
    pages = registries.validation_page(path, data, ())
    records = {r.case: r for r in read_journal(path, progress)}
    cases = []
    for r in records.values():
        if r.family in families:
            # a case of another version is listed as not validate_folder
            with suppress(InputError):
                case = assemble(families[r.family], r.params, r.form)
                if r.energy_bound is not None or _refines(case):
                    cases.append(case)
    meshes = discretisation_errors(cases, registries.reference, path, budget, progress)
    if meshes:  # the page was there while they were solved
        pages = registries.validation_page(path, data, meshes)
    return Validation(
        agreed=found.agreed, data=data, meshes=tuple(meshes), pages=tuple(pages)
    )


def _refines(case: CaseId) -> bool:
    """Return whether there is a finer mesh, or a reason why its family has none."""
    try:
        return case.family.refined(case.params) is not None
    except InputError:  # the reason, which `discretisation_errors` repeats
        return True


def as_text(data: Mapping[str, Any], meshes: Sequence[Discretisation] = ()) -> str:
    """Lay out one screen of what `harness.crossval.summary.as_data` returns."""
    parts = [legible(data["headline"]), _solvers(data["solvers"])]
    entries = {
        "Refuted claims": _refuted(data["disagreements"]),
        "Apart without a culprit": [
            f"{d['problem']}, tol {d['tol']:g}: {' and '.join(d['between'])} are "
            f"{_e(d['distance'])} apart, allowed {_e(d['allowed'])}"
            for d in data["unresolved"]
        ],
        "Certificates contradicted (a fault of ours)": [
            f"{_measured(d)}: {d['text']}" for d in data["contradictions"]
        ],
        "Not validate_folder": _together(data["not_validated"]),
        "Without a reference": [
            f"{d['problem']}: {d['text']}" for d in data["without_reference"]
        ],
    }
    parts += [_list(title, lines) for title, lines in entries.items() if lines]
    small = [
        f"{data['counts'][key]} {words}"
        for key, words in (
            ("remarks", "stand out from the other solvers, within what they claim"),
            ("unanswered", "measurements ended without an answer"),
        )
        if data["counts"][key]
    ]
    parts += ["; ".join(small) + "."] if small else []
    if meshes:
        title = (
            "Errors of the meshes, relative, in the energy norm, to which the "
            "certified ones add; `report` shows what they are worth"
        )
        parts.append(_list(title, [f"{d.case}: {d}" for d in meshes]))
    return "\n\n".join(parts)


def _solvers(rows: Sequence[Mapping[str, Any]]) -> str:
    """Lay out a row per solver."""
    columns = {
        "error_median": "error: median", "error_worst": "worst",
        "penetration": "penetration/h", "balance": "balance",
        "primal_dual": "primal-dual", "from_ours": "from smalbe",
    }  # fmt: skip
    if all(row["from_ours"] is None for row in rows):
        del columns["from_ours"]  # there is no smalbe to compare with
    head = ["solver", "tol", "answers", "refuted", "unanswered", *columns.values()]
    lines = [
        [
            legible(row["solver"]),
            f"{row['tol']:g}",
            *(str(row[key]) for key in ("answers", "refuted", "unanswered")),
            *(_e(row[key]) for key in columns),
        ]
        for row in rows
    ]
    table = aligned([head, *lines], right=range(1, len(head)))
    return (
        "Certified errors: relative, in the energy norm. They are those of the "
        f"solvers; the mesh adds its own.\n{table}"
    )


def _refuted(wrong: Sequence[Mapping[str, Any]]) -> list[str]:
    """List every claim, or, of very many, the worst of each solver."""
    if len(wrong) <= _MOST:
        return list(map(_wrong, wrong))
    own: dict[str, list[Mapping[str, Any]]] = {}
    for d in wrong:
        own.setdefault(d["solver"], []).append(d)
    return [
        f"{_wrong(max(claims, key=lambda d: d['error'] or 0.0))}"
        + (f" (the worst of {len(claims)})" if len(claims) > 1 else "")
        for claims in own.values()
    ]


def _wrong(d: Mapping[str, Any]) -> str:
    error = f"; error {_e(d['error'])}" if d["error"] is not None else ""
    return f"{_measured(d)}: {'; '.join(d['reasons'])}{error}"


def _measured(d: Mapping[str, Any]) -> str:
    return f"{d['solver']} on {d['case']}, tol {d['tol']:g}"


def _together(listed: Sequence[Mapping[str, Any]]) -> list[str]:
    """Say once what concerns all answers to a case."""
    counted = Counter((d["case"], d["text"]) for d in listed)
    return [
        f"{case} ({n} answer{'s' * (n != 1)}): {text}"
        for (case, text), n in counted.items()
    ]


def _list(title: str, lines: Sequence[str]) -> str:
    shown = [f"  {legible(line)}" for line in lines[:_MOST]]
    more = len(lines) - _MOST
    if more > 0:
        shown.append(f"  … and {more} more, see the page")
    return "\n".join([f"{title}:", *shown])


def _e(value: float | None) -> str:
    if value is None:
        return "-"
    return brief(value) if value else "0"


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class Conformance:
    """Results of the conformance suite for one solver."""

    solver: str  #: its name, or the class of an object
    results: Mapping[str, Result]  #: by the name of the check

    @property
    def conforms(self) -> bool:
        """True if no check fails, and the solver solved something."""
        return not self.objection

    @property
    def objection(self) -> str:
        """The reason why the solver does not conform; empty if it does."""
        if self.failed:
            return f"fails {some(map(repr, self.failed))}"
        if not any(
            r.grade is Grade.PASS and name.startswith(FINDS)
            for name, r in self.results.items()
        ):
            return f"passes no check {FINDS!r}: it solved nothing"
        return ""

    @property
    def failed(self) -> Mapping[str, str]:
        """Messages of the checks that fail, by name."""
        return {n: r.message for n, r in self.results.items() if r.grade is Grade.FAIL}

    def to_dict(self) -> dict[str, Any]:
        """Return plain data; `checks` is what ``test-solver --json`` prints."""
        checks = [
            dict(solver=self.solver, check=name, **r._asdict())
            for name, r in self.results.items()
        ]
        return {"solver": self.solver, "conforms": self.conforms, "checks": checks}

    def __repr__(self) -> str:
        rows = [(r.grade, name, r.message) for name, r in self.results.items()]
        grades = Counter(r.grade for r in self.results.values())
        counts = ", ".join(f"{grades[g]} {g}" for g in Grade)
        return f"{aligned(rows)}\n{self.solver}: {counts}"

    def _repr_html_(self) -> str:
        return f"<pre>{escape(repr(self))}</pre>"


def test_solver(
    solver: str | Solver,
    *,
    plugins: Plugins = (),  # noqa: PT028  # not a test
    checks: Iterable[str] | None = None,  # noqa: PT028
    registries: Registries | None = None,  # noqa: PT028
) -> Conformance:
    """Run the conformance suite on a solver, in a process of its own.

    A check whose process is killed or hangs fails; the others go on.

    Parameters
    ----------
    solver : a name of `solvers`, or an object as `mortarbench.solve` takes it
    plugins : Python files with more solvers
    checks : names of checks; None: all
    registries : what is known, instead of ours, what is installed and `plugins`

    Raises
    ------
    InputError
        When there is no such solver or check, or the solver cannot be copied.

    """
    check_solver(solver)
    registries = known(plugins) if registries is None else registries
    wanted = list(CHECKS if checks is None else checks)
    for check in wanted:
        if check not in CHECKS:
            raise unknown("check", str(check), CHECKS)
    name = solver if isinstance(solver, str) else type(solver).__name__
    spec = SolverSpec(name=name, label=name)
    with scratch_folder() as scratch, ExitStack() as stack:
        copy = None
        if isinstance(solver, str):
            resolve(spec, registries.solvers)
        else:
            copy = scratch / "solver.pickle"
            write_solver(copy, solver)
        command = registries.worker_command(spec, copy)
        worker = WorkerProcess(command, scratch / "worker.log")
        stack.callback(worker.close)
        results = {check: _checked(worker, check) for check in wanted}
    return Conformance(solver=name, results=results)


def _checked(worker: WorkerProcess, check: str) -> Result:
    """Run one check; what ends the process of the solver is a failure of it."""
    reply = worker.ask(
        {"check": check}, time_limit=TIME_LIMIT, memory_limit=MEMORY_LIMIT
    )
    if reply.answer is None:
        is_weakness = check.startswith(KEEPS)
        return Result(Grade.WEAK if is_weakness else Grade.FAIL, reply.message)
    grade, *others = (reply.answer[field] for field in Result._fields)
    return Result(Grade(grade), *others)
