"""Merging of result folders that may contain measurements of several environments.

All measurements of all folders are kept unchanged. Session and run_id identify a
measurement; if two folders contain the same measurement, for example because both are
merges of a third folder, its line is written once. The suite is that of the first
folder.

The journal of the new folder is written last, in a single step. A folder without a
journal contains no measurements, so the same command can be given again if a merge was
killed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path

from mortarbench.harness.errors import InputError, shown
from mortarbench.harness.files.durable import replace_file, report_full_disk
from mortarbench.harness.files.reading import read_text
from mortarbench.harness.files.store import copy_stored
from mortarbench.harness.record import Record
from mortarbench.harness.results.folder import (
    environment_of,
    keep_environment,
    lock_folder,
    refuse_foreign,
    write_json,
)
from mortarbench.harness.results.journal import read_journal, refuse_other_solver
from mortarbench.harness.suite.growth import refuse_unequal
from mortarbench.harness.suite.suite import read_stored


def merge(
    sources: Sequence[Path], out: Path, tell: Callable[[str], None] = lambda _: None
) -> list[Record]:
    """Merge result folders into a new folder, or into the result of an earlier merge.

    tell : called with messages of one line on repeated measurements and missing files

    Returns
    -------
    the records of `out`

    Raises
    ------
    InputError
        If a source contains no measurements, or contains a link; if two folders contain
        different records of one measurement, or different solvers under one label; if
        the limits or accuracies of the suites differ; if `out` is a source, lies in a
        source, or contains a source; if `out` contains results of a run or files of the
        user; or if the disk is full. In these cases, the journal of `out` does not
        change.

    """
    for source in sources:
        one, other = source.resolve(), out.resolve()
        if one == other or one in other.parents or other in one.parents:
            raise InputError(
                f"--out {out} is, contains or lies inside {source}; expected a folder "
                "outside the folders to merge"
            )
    journals = {source: read_journal(source, tell) for source in dict.fromkeys(sources)}
    for source, records in journals.items():
        if not records:
            raise InputError(
                f"{source}: no measurements; expected a result folder of `run`"
            )
    refuse_foreign(out)
    journal = out / "journal" / "merged.jsonl"
    if others := {*journal.parent.glob("*.jsonl")} - {journal}:
        raise InputError(
            f"{out} contains measurements of a run (journal/{min(others).name}); "
            "expected a new folder, or the result of an earlier merge; choose another "
            "--out"
        )
    folders = [*[out] * journal.exists(), *journals]
    _check_labels({f: journals.get(f) or read_journal(f) for f in folders})
    paths = [path for f in folders if (path := f / "suite.toml").exists()]
    suites = [read_stored(path) for path in paths]
    for path, suite_file in zip(paths, suites, strict=True):
        refuse_unequal(str(paths[0]), suites[0], str(path), suite_file)
    suite = read_text(paths[0]) if paths else ""
    with report_full_disk(out), lock_folder(out):
        merged = _united(
            {
                folder: journals.get(folder) or read_journal(folder)
                for folder in folders
            },
            tell,
        )
        for source, records in journals.items():
            digests = {d for r in records for d in (r.vectors, r.fields) if d}
            missing = [d for d in sorted(digests) if not copy_stored(source, out, d)]
            if missing:
                tell(
                    f"{source}: {len(missing)} of {len(digests)} solutions are not in "
                    "vectors/"
                )
        _copy_environments(folders, out, merged, tell)
        if suite:  # folders without suites may be merged as well
            replace_file(out / "suite.toml", suite.encode())
        lines = "".join(f"{r.to_json()}\n" for r in merged)
        replace_file(journal, lines.encode())
    return merged


def _check_labels(journals: Mapping[Path, Sequence[Record]]) -> None:
    """Raise InputError if a label has different solvers or options in two folders."""
    labels: dict[str, Record] = {}
    for folder, records in journals.items():
        for r in records:
            first = labels.setdefault(r.solver, r)
            refuse_other_solver(str(folder), r, first.method, first.options)


def _united(
    journals: Mapping[Path, Sequence[Record]], tell: Callable[[str], None]
) -> list[Record]:
    """Return the records of all folders; a measurement in several folders occurs once.

    Raises
    ------
    InputError
        If two folders contain different records of the same measurement.

    """
    united: dict[str, Record] = {}
    for folder, records in journals.items():
        before = len(united)
        for r in records:
            if r != united.setdefault(r.identity, r):
                raise InputError(
                    f"{folder}: the record of run_id {shown(r.run_id)} in session "
                    f"{shown(r.session)} differs from that of another folder; expected "
                    "equal records of one measurement; restore the changed journal"
                )
        if repeated := before + len(records) - len(united):
            tell(
                f"{folder}: {repeated} of {len(records)} measurements are already "
                "present and are counted once"
            )
    return [*united.values()]


def _copy_environments(
    folders: Sequence[Path],
    out: Path,
    records: Iterable[Record],
    tell: Callable[[str], None],
) -> None:
    """Store the environments of all records, the first also as environment.json."""
    is_first = True
    for digest in dict.fromkeys(r.environment for r in records):
        for folder in folders:
            with suppress(InputError):
                environment = environment_of(folder, digest)
                keep_environment(out, digest, environment)
                if is_first:
                    write_json(out / "environment.json", environment)
                is_first = False
                break
        else:
            tell(f"no folder contains the environment {digest}")
