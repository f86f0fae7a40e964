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
from typing import Any

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
from mortarbench.harness.results.journal import check_labels, read_journal
from mortarbench.harness.suite.growth import refuse_unequal
from mortarbench.harness.suite.suite import read_suite


def merge(
    sources: Sequence[Path], out: Path, tell: Callable[[str], None] = lambda _: None
) -> list[Record]:
    """Merge result folders into a new folder.

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
        source, or contains a source, or contains measurements or files of the user; or
        if the disk is full. In these cases, `out` has no
        journal afterwards.

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
    if journal := next((out / "journal").glob("*.jsonl"), None):
        raise InputError(
            f"{out} contains measurements (journal/{journal.name}); expected a new "
            "folder; choose another --out"
        )
    paths = [path for folder in journals if (path := folder / "suite.toml").exists()]
    suites = [read_suite(path) for path in paths]
    for path, suite in zip(paths, suites, strict=True):
        refuse_unequal(str(paths[0]), suites[0], str(path), suite)
    merged = _united(journals, tell)
    with report_full_disk(out), lock_folder(out):
        for source, records in journals.items():
            digests = {d for r in records for d in (r.vectors, r.fields) if d}
            missing = [d for d in sorted(digests) if not copy_stored(source, out, d)]
            if missing:
                tell(
                    f"{source}: {len(missing)} of {len(digests)} solutions are not in "
                    "vectors/"
                )
        _copy_environments([*journals], out, merged, tell)
        if paths:  # folders without suites may be merged as well
            replace_file(out / "suite.toml", read_text(paths[0]).encode())
        lines = "".join(f"{r.to_json()}\n" for r in merged)
        replace_file(out / "journal" / "merged.jsonl", lines.encode())
    return merged


def _united(
    journals: Mapping[Path, Sequence[Record]], tell: Callable[[str], None]
) -> list[Record]:
    """Return the records of all folders; a measurement in several folders occurs once.

    Raises
    ------
    InputError
        If two folders contain different records of the same measurement, or different
        solvers or options under one label.

    """
    united: dict[str, Record] = {}
    labels: dict[str, tuple[str, Mapping[str, Any]]] = {}
    for folder, records in journals.items():
        check_labels(str(folder), records, labels)
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
