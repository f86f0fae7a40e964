"""Merging of result folders that may contain measurements of several environments.

A measurement is identified by its run_id and its environment. If two folders contain
the same measurement, the measurement of the first folder is kept. Measurements with
equal run_ids but different environments are all kept. Except for the first, each of
these measurements gets a new run_id, which is a digest of its old run_id and its
environment.

The journal of the new folder is written last, in a single step. A folder without a
journal contains no measurements, so the same command can be given again if a merge was
killed.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mortarbench.harness.digest import hex_digest
from mortarbench.harness.errors import InputError
from mortarbench.harness.files.copies import check_copies, merge_copies
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
from mortarbench.harness.suite.growth import as_toml, unite
from mortarbench.harness.suite.suite import read_stored

_DUPLICATES_NOTE = "measurements are already present and are counted once"
JOURNAL = "merged"  #: name of the only journal of a merged folder


@dataclass(eq=False)
class _Union:
    """Union of the measurements of several folders."""

    records: dict[str, Record] = field(
        default_factory=dict
    )  #: measurements by run_id, in order
    _keys: set[tuple[str, str]] = field(
        default_factory=set
    )  # (run_id, environment) of each measurement
    _contents: set[str] = field(
        default_factory=set
    )  # digests of the records without run_id

    def add(self, record: Record) -> bool:
        """Add a measurement; return True if it is a duplicate."""
        # Compare the content first, since an earlier merge may have added the same
        # record with a new run_id.
        content = hex_digest([record.replace(run_id="").to_json().encode()], 32)
        if content in self._contents:
            return True
        if (record.run_id, record.environment) in self._keys:
            return True
        self._keys.add((record.run_id, record.environment))
        if record.run_id in self.records:
            record = record.replace(
                run_id=hex_digest([f"{record.run_id} {record.environment}".encode()])
            )
        if record.run_id in self.records:
            return True
        self._keys.add((record.run_id, record.environment))
        self._contents.add(content)
        self.records[record.run_id] = record
        return False


def merge(
    sources: Sequence[Path], out: Path, tell: Callable[[str], None] = lambda _: None
) -> list[Record]:
    """Merge result folders into a new folder, or into the result of an earlier merge.

    tell : called with messages of one line on duplicates and missing files

    Returns
    -------
    the records of `out`

    Raises
    ------
    InputError
        If a source contains no measurements, or contains a link; if the suites differ
        in settings on which measurements depend; if `out` is a source, lies in a
        source, or contains a source; if `out` contains results of a run or files of the
        user; or if the disk is full. In these cases, the journal of `out` does not
        change.

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
    for folder in folders:
        check_copies(folder)
    with report_full_disk(out), lock_folder(out):
        union = _Union()
        for folder in existing:
            for record in read_journal(folder):
                union.add(record)
        for source, records in journals.items():
            if duplicates := sum(map(union.add, records)):
                tell(f"{source}: {duplicates} of {len(records)} {_DUPLICATES_NOTE}")
        for source, records in journals.items():
            _copy_solutions(source, out, records, tell)
        merge_copies(list(journals), out, tell)
        _copy_environments(folders, out, union.records.values(), tell)
        faults = [f.to_json() for folder in folders for f in read_faults(folder)]
        if faults:
            text = "".join(f"{line}\n" for line in dict.fromkeys(faults))
            replace_file(out / FAULTS, text.encode())
        replace_file(out / "suite.toml", suite.encode())
        lines = "".join(f"{r.to_json()}\n" for r in union.records.values())
        replace_file(_journal(out), lines.encode())
    return [*union.records.values()]


def _journal(folder: Path) -> Path:
    return folder / "journal" / f"{JOURNAL}.jsonl"


def _read(source: Path, tell: Callable[[str], None]) -> list[Record]:
    """Read the records of a folder, and add a session to old records without a session.

    The session is a digest of the environment and of the earliest start of a record
    without a session in this environment.
    """
    records = read_journal(source, tell)
    if not records:
        raise InputError(
            f"{source}: no measurements; expected a result folder of `run`"
        )
    first: dict[str, str] = {}
    for r in records:
        if not r.session:
            earliest = min(first.get(r.environment, r.started), r.started)
            first[r.environment] = earliest
    sessions = {
        environment: hex_digest([f"{environment} {started}".encode()])
        for environment, started in first.items()
    }
    return [
        r if r.session else r.replace(session=sessions[r.environment]) for r in records
    ]


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
