"""Reports on a result folder, and on changes between result folders or solvers."""

from __future__ import annotations

import re
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from mortarbench.harness import checked
from mortarbench.harness.errors import InputError, shown
from mortarbench.harness.files.durable import report_full_disk
from mortarbench.harness.record import VERIFIED_FACTOR

if TYPE_CHECKING:
    from mortarbench.reports.compare import Change
    from mortarbench.reports.measurements import Measurements

FORMATS = ("html", "md", "tex", "csv", "parquet")  #: formats of a report
SLOWER = 1.2  #: factor from which on a solver counts as slower, unless one is given
_GATE = re.compile(r"worse|slower(?:=(?P<factor>[0-9.]+))?")


@dataclass(frozen=True, kw_only=True)
class Report:
    """Files and main statements of a report."""

    files: tuple[Path, ...]
    said: tuple[str, ...] = ()  #: main statements, one line each
    #: changes of the solvers: the plain data that ``report --json`` prints
    changes: tuple[dict[str, Any], ...] = ()
    failed_on: tuple[str, ...] = ()  #: conditions of `fail_on` that are met
    undecided: bool = False  #: True if a condition of `fail_on` cannot be decided

    @property
    def code(self) -> int:
        """Exit code: 1 if a condition is met, 2 if one cannot be decided, else 0."""
        return 1 if self.failed_on else 2 if self.undecided else 0

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
            "undecided": self.undecided,
            "files": [*map(str, self.files)],
        }

    def __repr__(self) -> str:
        return "\n".join([*self.said, str(self.page or f"{len(self.files)} files")])


def report(
    folder: Annotated[str | Path, "DIR"],
    *others: Annotated[str | Path | None, "DIR2"],
    formats: Annotated[Sequence[str], "--format html,md,tex,csv,parquet"] = FORMATS,
    factor: Annotated[float, "F"] = VERIFIED_FACTOR,
    fail_on: Annotated[Sequence[str], "worse,slower=1.2"] = (),
    compare: Annotated[Sequence[str], "OLD,NEW"] = (),
    pair: Annotated[Sequence[str], "A=B"] = (),
) -> Report:
    """Write a report on a result folder, or on changes.

    Parameters
    ----------
    folder : result folder of `run`; its report is written to its subfolder ``report``
    others : report the changes from DIR to DIR2, and to each further folder, in
        DIR2/report/against-DIR. The report on `folder` is then not written
    formats : formats to write; default: all
    factor : an answer is verified if every residual is at most F times the tolerance
    fail_on : exit with 1 if a verdict became worse (worse), or if a solver became
        slower by the given factor (slower=1.2), and with 2 if this cannot be told
    compare : report the change from the solver OLD to the solver NEW in DIR
    pair : compare the solver A of DIR with the solver B of DIR2

    Raises
    ------
    InputError
        If a folder contains no measurements, or an argument is invalid.

    Examples
    --------
    >>> import mortarbench as mb
    >>> results = mb.run("smoke", out="out/smoke", cases=["*/dual"], solvers=["pdas"])
    >>> mb.report("out/smoke", formats=["html"]).page.name
    'index.html'

    """
    formats = checked.names("formats", "format", formats, FORMATS)
    gates = _gates(fail_on)
    factor = checked.positive("factor", factor)
    first = checked.result_folder("folder", folder)
    after = [checked.result_folder("others", o) for o in others if o is not None]
    if not (after or compare):
        if gates or pair:
            raise InputError(
                "fail_on and pair need two folders, or two solvers; expected "
                "report DIR DIR2, or report DIR --compare OLD,NEW"
            )
        from mortarbench.reports.folder import write_report

        with report_full_disk(first):
            files, said = write_report(first, formats, factor)
        return Report(files=tuple(files), said=tuple(said))
    from mortarbench.reports.measurements import read_measurements

    with ExitStack() as stack:
        stack.enter_context(report_full_disk(first))
        before = read_measurements(first, factor)
        if compare:
            labels = checked.names("compare", "solver", compare, before.solvers)
            if len(labels) != 2:
                raise InputError(
                    f"compare = {shown(labels)}; expected two labels, OLD,NEW"
                )
            pairs = [(labels[0], labels[1])]
            target = first / "report" / "compared"
            return _changes(before, before, pairs, target, formats, gates)
        found = []
        for one in after:
            stack.enter_context(report_full_disk(one))
            other = read_measurements(one, factor)
            target = one / "report" / f"against-{first.resolve().name}"
            pairs = _pairs(before, other, pair)
            found.append(_changes(before, other, pairs, target, formats, gates))
    return Report(
        files=tuple(file for r in found for file in r.files),
        said=tuple(line for r in found for line in r.said),
        changes=tuple(change for r in found for change in r.changes),
        failed_on=tuple(dict.fromkeys(what for r in found for what in r.failed_on)),
        undecided=any(r.undecided for r in found),
    )


def _gates(fail_on: Sequence[str]) -> dict[str, float]:
    """Return the conditions by name, with the factor of `slower`."""
    gates = {}
    for text in checked.texts("fail_on", fail_on):
        match = _GATE.fullmatch(text)
        limit = float(match["factor"] or SLOWER) if match else 0.0
        if limit <= 1:
            raise InputError(
                f"fail_on: {shown(text)}; expected worse, slower, or slower=FACTOR "
                "with a factor above 1"
            )
        gates[text.partition("=")[0]] = limit
    return gates


def _pairs(
    before: Measurements, after: Measurements, pair: Sequence[str]
) -> list[tuple[str, str]]:
    """Return the pairs of labels to compare: those of `pair`, or all common ones."""
    pairs = []
    for text in checked.texts("pair", pair):
        # labels contain "=", so that the text is split where both parts are labels
        cuts = [m.start() for m in re.finditer("=", text)]
        splits = [(text[:i], text[i + 1 :]) for i in cuts]
        fits = [s for s in splits if s[0] in before.solvers and s[1] in after.solvers]
        if not fits:
            raise InputError(
                f"pair = {shown(text)}; expected A=B, where A is one of "
                f"{', '.join(before.solvers)}, and B one of {', '.join(after.solvers)}"
            )
        pairs.append(fits[0])
    common = [(s, s) for s in before.solvers if s in after.solvers]
    if not (pairs or common):
        raise InputError(
            f"{before.folder} and {after.folder} have no solver in common; expected "
            "runs of one suite, or pair = A=B"
        )
    return pairs or common


def _changes(
    before: Measurements,
    after: Measurements,
    pairs: Sequence[tuple[str, str]],
    target: Path,
    formats: Sequence[str],
    gates: dict[str, float],
) -> Report:
    """Compare, write the page, and judge the conditions `gates`."""
    from mortarbench.reports import comparison
    from mortarbench.reports.compare import Outcome, compare

    limit = gates.get("slower", SLOWER)
    changes = compare(before, after, pairs)
    said = [
        comparison.conditions(before, after, pairs),
        *comparison.sentences(changes, limit),
    ]
    title = f"{before.name} to {after.name}"
    if before is after:
        title = f"{pairs[0][0]} to {pairs[0][1]} in {before.name}"
    files = comparison.write_comparison(target, title, changes, said, formats)
    outcomes = [change.outcome(limit) for change in changes]
    failed = ["slower"] * ("slower" in gates and Outcome.SLOWER in outcomes)
    failed += ["worse"] * ("worse" in gates and any(len(c.worse) for c in changes))
    return Report(
        files=tuple(files),
        said=tuple(said),
        changes=tuple(_data(change, limit) for change in changes),
        failed_on=tuple(failed),
        undecided="slower" in gates and Outcome.CANNOT_TELL in outcomes,
    )


def _data(change: Change, limit: float) -> dict[str, Any]:
    """Return the change of a solver as plain data."""
    ratio = change.ratio
    return {
        "before": change.before,
        "after": change.after,
        "outcome": change.outcome(limit).name.lower(),
        "limit": limit,
        "ratio": ratio and ratio.value,
        "low": ratio.low if ratio and ratio.is_known else None,
        "high": ratio.high if ratio and ratio.is_known else None,
        "cells": change.cells,
        "repeats": change.repeats,
        "worse": change.worse[["case", "tol", "old", "new"]].to_dict("records"),
    }
