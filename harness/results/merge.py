"""Merging of result folders that may contain measurements of several environments.

All measurements of all folders are kept unchanged. Session and run_id identify a
measurement; if two folders contain the same measurement, for example because both are
merges of a third folder, its line is written once.

The journal of the new folder is written last, in a single step. A folder without a
journal contains no measurements, so the same command can be given again if a merge was
killed.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from mortarbench.harness.errors import InputError, shown
from mortarbench.harness.files.durable import replace_file, report_full_disk
from mortarbench.harness.files.store import copy_stored
from mortarbench.harness.record import Record
from mortarbench.harness.results.faults import FAULTS, read_faults
from mortarbench.harness.results.folder import (
    environment_of,
    keep_environment,
    lock_folder,
    refuse_foreign,
    refuse_links,
)
from mortarbench.harness.results.journal import read_journal
from mortarbench.harness.suite.growth import unite
from mortarbench.harness.suite.suite import as_toml, read_stored

JOURNAL = "merged"  #: name of the only journal of a merged folder


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
        different records of one measurement; if the suites differ in settings on which
        measurements depend; if `out` is a source, lies in a source, or contains a
        source; if `out` contains results of a run or files of the user; or if the disk
        is full. In these cases, the journal of `out` does not change.

    """
    for source in sources:
        _refuse_nested(source, out)
    journals = {source: _read(source, tell) for source in dict.fromkeys(sources)}
    refuse_foreign(out)
    _refuse_run(out)
    existing = [out] if _journal(out).exists() else []
    folders = [*existing, *journals]
    paths = {str(folder): folder / "suite.toml" for folder in folders}
    suites = {name: read_stored(path) for name, path in paths.items() if path.exists()}
    suite = as_toml(unite(suites))
    with report_full_disk(out), lock_folder(out):
        merged: dict[str, Record] = {}
        for folder in existing:
            merged |= {r.identity: r for r in read_journal(folder)}
        for source, records in journals.items():
            if repeated := _add(merged, records, source):
                tell(
                    f"{source}: {repeated} of {len(records)} measurements are already "
                    "present and are counted once"
                )
        for source, records in journals.items():
            _copy_solutions(source, out, records, tell)
        _copy_environments(folders, out, merged.values(), tell)
        faults = [f.to_json() for folder in folders for f in read_faults(folder)]
        if faults:
            text = "".join(f"{line}\n" for line in dict.fromkeys(faults))
            replace_file(out / FAULTS, text.encode())
        replace_file(out / "suite.toml", suite.encode())
        lines = "".join(f"{r.to_json()}\n" for r in merged.values())
        replace_file(_journal(out), lines.encode())
    return [*merged.values()]


def _journal(folder: Path) -> Path:
    return folder / "journal" / f"{JOURNAL}.jsonl"


def _read(source: Path, tell: Callable[[str], None]) -> list[Record]:
    """Read the records of a folder, of which there must be at least one."""
    records = read_journal(source, tell)
    if not records:
        raise InputError(
            f"{source}: no measurements; expected a result folder of `run`"
        )
    return records


def _add(merged: dict[str, Record], records: Iterable[Record], source: Path) -> int:
    """Add the records of a folder in place; return how many were already present.

    Raises
    ------
    InputError
        If another folder contains a different record of the same measurement.

    """
    repeated = 0
    for r in records:
        if r != merged.setdefault(r.identity, r):
            raise InputError(
                f"{source}: the record of run_id {shown(r.run_id)} in session "
                f"{shown(r.session)} differs from that of another folder; expected "
                "equal records of one measurement; restore the changed journal"
            )
        repeated += r is not merged[r.identity]
    return repeated


def _refuse_nested(source: Path, out: Path) -> None:
    """Raise `InputError` if `out` equals, contains or lies in `source`."""
    target, origin = out.resolve(), source.resolve()
    if target == origin:
        raise InputError(
            f"--out {out} is one of the folders to merge; expected a different folder"
        )
    for inner, outer in ((target, origin), (origin, target)):
        if outer in inner.parents:
            raise InputError(
                f"--out {out}: {inner} lies inside {outer}; expected a folder "
                "outside the folders to merge"
            )


def _refuse_run(out: Path) -> None:
    """Raise `InputError` if `out` contains measurements of a run."""
    if not out.is_dir():
        return
    refuse_links(out)
    others = [p.name for p in (out / "journal").glob("*.jsonl") if p != _journal(out)]
    if others:
        raise InputError(
            f"{out} contains measurements of a run (journal/{min(others)}); expected a "
            "new folder, or the result of an earlier merge; choose another --out"
        )


def _copy_solutions(
    source: Path, out: Path, records: Sequence[Record], tell: Callable[[str], None]
) -> None:
    digests = {d for r in records for d in (r.vectors, r.fields) if d is not None}
    missing = [d for d in sorted(digests) if not copy_stored(source, out, d)]
    if missing:
        tell(
            f"{source}: {len(missing)} of {len(digests)} solutions are not in vectors/"
        )


def _copy_environments(
    folders: Sequence[Path],
    out: Path,
    records: Iterable[Record],
    tell: Callable[[str], None],
) -> None:
    """Store the environments of all records, the first also as environment.json."""
    stored: list[Mapping[str, Any]] = []
    for digest in dict.fromkeys(r.environment for r in records):
        environment = _environment(folders, digest)
        if environment is None:
            tell(f"no folder contains the environment {digest}")
            continue
        content = {k: v for k, v in environment.items() if k != "digest"}
        keep_environment(out, digest, content)
        stored.append(environment)
    if stored:
        text = json.dumps(stored[0], indent=1) + "\n"
        replace_file(out / "environment.json", text.encode())


def _environment(folders: Sequence[Path], digest: str) -> Mapping[str, Any] | None:
    for folder in folders:
        with suppress(InputError):
            return environment_of(folder, digest)
    return None
