"""Reports on a result folder, and on the changes between result folders."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mortarbench.harness import checked
from mortarbench.harness.errors import InputError
from mortarbench.harness.files.durable import report_full_disk
from mortarbench.harness.record import VERIFIED_FACTOR
from mortarbench.registries import Registries, load_registries, report_folder

if TYPE_CHECKING:
    from mortarbench.harness.running.pairs import Ratio
    from mortarbench.reports.compare.changes import Comparison, Pair
    from mortarbench.reports.compare.regressions import Slower


FORMATS = ("html", "md", "tex", "csv", "parquet")  #: formats of a report
GATES = ("worse", "slower")  #: values allowed in the argument `fail_on` of `report`


@dataclass(frozen=True, kw_only=True)
class Report:
    """Files and main statements of a report."""

    files: tuple[Path, ...]
    said: tuple[str, ...] = ()  #: main statements, one line each
    #: changes from the first folder to each of the others: the plain data that
    #: ``report --json`` prints
    changes: tuple[dict[str, Any], ...] = ()
    failed_on: tuple[str, ...] = ()  #: conditions of `fail_on` that are met

    @property
    def page(self) -> Path | None:
        """HTML page, or None if the format was not requested."""
        return next((file for file in self.files if file.suffix == ".html"), None)

    def to_dict(self) -> dict[str, Any]:
        """Return the report as plain data, the output of ``report --json``."""
        return {
            "said": [*self.said],
            "changes": [*self.changes],
            "failed_on": [*self.failed_on],
            "files": [*map(str, self.files)],
        }

    def __repr__(self) -> str:
        return "\n".join([*self.said, str(self.page or f"{len(self.files)} files")])

    def _repr_html_(self) -> str:
        lines = "".join(f"<p>{escape(line)}</p>" for line in self.said)
        if self.page is None:
            return f"{lines}<p>{len(self.files)} files</p>"
        page = escape(str(self.page), quote=True)
        return f"{lines}<p><a href='{page}'>{page}</a></p>"


def report(
    folder: Annotated[str | Path, "DIR"],
    *others: Annotated[str | Path | None, "DIR2"],
    formats: Annotated[Sequence[str], "--format html,md,tex,csv,parquet"] = FORMATS,
    factor: Annotated[float, "F"] = VERIFIED_FACTOR,
    fail_on: Annotated[Sequence[str], "worse,slower"] = (),
    pool_forms: bool = False,
    registries: Registries | None = None,
) -> Report:
    """Write a report on a result folder, or on the changes from it to other folders.

    Parameters
    ----------
    folder : result folder of `run`; its report is written to its subfolder ``report``
    others : report the changes from DIR to DIR2, and to each further folder, in
        DIR2/report/against-DIR. The report on `folder` is then not written
    formats : formats to write; default: all
    factor : an answer is verified if every residual is at most F times the tolerance
    fail_on : exit with 1 if, from DIR to DIR2, a verdict became worse (worse) or a
        solver became slower by the criterion in docs/statistics-growth.md (slower). In
        Python, `Report.failed_on` lists the conditions that are met
    pool_forms : compute means, rankings and profiles over the cases of all forms
        together, where a declined form counts as unsolved, not within each form
    registries : used instead of the built-in registries, for the function that writes
        the report

    Raises
    ------
    InputError
        If a folder contains no measurements, a format or the factor is invalid,
        `pool_forms` is requested for a comparison, or it cannot be decided whether
        a condition in `fail_on` is met.

    Examples
    --------
    >>> import mortarbench as mb
    >>> results = mb.run("smoke", out="out/smoke", cases=["*/dual"], solvers=["pdas"])
    >>> mb.report("out/smoke", formats=["html"]).page.name
    'index.html'

    """
    formats = checked.names("formats", "format", formats, FORMATS)
    fail_on = checked.names("fail_on", "gate", fail_on, GATES)
    factor = checked.positive("factor", factor)
    pool_forms = checked.flag("pool_forms", pool_forms)
    registries = load_registries((), Registries() if registries is None else registries)
    if fail_on and not any(others):
        raise InputError("fail_on needs a second folder; expected report DIR DIR2")
    first = checked.result_folder("folder", folder)
    after = [checked.result_folder("others", o) for o in others if o is not None]
    if not after:
        write = registries.report
        with report_full_disk(first):
            files = write(first, formats, factor=factor, pool_forms=pool_forms)
        if write is not report_folder:  # `answer` summarises only the built-in report
            return Report(files=tuple(files))
        from mortarbench.reports import answer

        return Report(files=tuple(files), said=tuple(answer(first, factor)))
    if pool_forms:
        raise InputError(
            "--pool-forms applies to the report on one folder, not to a comparison of "
            "two folders, which pairs equal cases; omit it or the second folder"
        )
    from mortarbench.reports import write_comparisons

    with ExitStack() as stack:
        for one in after:
            stack.enter_context(report_full_disk(one))
        comparisons, said, pages = write_comparisons(first, after, formats, factor)
    changes = tuple(map(_comparison_data, comparisons))
    failed = [what for what in fail_on if any(change[what] for change in changes)]
    undecided = _undecided(changes, fail_on)
    if undecided and not failed:
        raise InputError(undecided[0])
    return Report(
        files=tuple(pages),
        said=(*said, *undecided),
        changes=changes,
        failed_on=tuple(dict.fromkeys(failed)),
    )


def _undecided(changes: Sequence[dict[str, Any]], fail_on: Sequence[str]) -> list[str]:
    """Return the reasons why conditions in `fail_on` cannot be decided, if any."""
    lines = []
    for change in changes if fail_on else ():
        between = f"{change['before']} and {change['after']}"
        if not change["cells"]:
            lines.append(
                f"fail-on {','.join(fail_on)}: no cell (a solver on a case at a "
                f"tolerance) is in both {between}; expected two runs of one suite"
            )
        elif "slower" in fail_on and (why := change["slower_not_judged"]):
            lines.append(f"fail-on slower: {between}: {why}")
    return lines


def _comparison_data(c: Comparison) -> dict[str, Any]:
    """Return the changes between two folders as plain data."""
    from mortarbench.reports.compare.changes import mean_ratio
    from mortarbench.reports.compare.regressions import regressions

    judged = regressions(c)
    means = {s: mean for s in c.solvers if (mean := mean_ratio(c.of(s)))}
    return {
        "before": str(c.before.directory),
        "after": str(c.after.directory),
        "cells": len(c.pairs),
        "only_before": len(c.only_before),
        "only_after": len(c.only_after),
        "same_machine": all(p.same_machine for p in c.pairs),
        "worse": [_verdicts(p) for p in c.worse],
        "better": [_verdicts(p) for p in c.pairs if p.turn < 0],
        "other_answers": [_cell(p) for p in c.pairs if p.other_answer],
        "slower": [_slower(one) for one in judged.slower],
        "slower_judged": {"solvers": judged.solvers, "cells": judged.cells},
        "slower_not_judged": judged.why_not or None,
        "slower_unverified": list(judged.unverified),
        "ratios": {
            s: _interval(mean) | {"cells": mean.cells} for s, mean in means.items()
        },
    }


def _cell(p: Pair) -> dict[str, Any]:
    return {"case": p.after.case, "solver": p.after.solver, "tol": p.after.tol}


def _verdicts(p: Pair) -> dict[str, Any]:
    verdicts = {"before": p.before.verdict.value, "after": p.after.verdict.value}
    return _cell(p) | verdicts


def _slower(one: Slower) -> dict[str, Any]:
    return {
        "solver": one.solver,
        "case": one.case or None,
        "tol": one.tol,
        "ratio": _interval(one.ratio),
        "relative": _interval(one.relative),
    }


def _interval(ratio: Ratio | Any) -> dict[str, float | None]:
    """Return a ratio with the ends of its interval, which are None if undefined."""
    bounded = 0 < ratio.low <= ratio.high < float("inf")
    return {
        "value": ratio.value,
        "low": ratio.low if bounded else None,
        "high": ratio.high if bounded else None,
    }
