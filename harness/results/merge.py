"""Several result folders as one: every measurement once, environments apart.

A measurement is known by its run_id and its environment. What two folders hold of both
counts once, and the first folder's counts. What they hold in different environments is
kept of each; the later one gets a run_id of its own, made of both.

Nothing is a part of the new folder until its journal is, which is written last and as a
whole: a merge that was killed is done again by the same command.
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
    locked,
    refuse_foreign,
    refuse_links,
)
from mortarbench.harness.results.journal import read_journal
from mortarbench.harness.suite.growth import as_toml, united
from mortarbench.harness.suite.suite import read_stored

_AGAIN = "are there already, and count once"
JOURNAL = "merged"  #: name of the only journal of a folder that was merged


@dataclass(eq=False)
class _Union:
    """What the folders hold together."""

    records: dict[str, Record] = field(default_factory=dict)  # by run_id, in order
    _known: dict[tuple[str, str], Record] = field(default_factory=dict)
    _contents: set[str] = field(default_factory=set)

    def add(self, record: Record) -> bool:
        """Take a measurement; tell whether it is one that is there already."""
        content = hex_digest([record.replace(run_id="").to_json().encode()], 32)
        if content in self._contents:
            return True
        if (record.run_id, record.environment) in self._known:
            return True
        self._known[record.run_id, record.environment] = record
        if record.run_id in self.records:
            record = record.replace(
                run_id=hex_digest([f"{record.run_id} {record.environment}".encode()])
            )
        if record.run_id in self.records:
            return True
        self._known[record.run_id, record.environment] = record
        self._contents.add(content)
        self.records[record.run_id] = record
        return False


def merge(
    sources: Sequence[Path], out: Path, tell: Callable[[str], None] = lambda _: None
) -> list[Record]:
    """Make one result folder of several, or add them to one that was made so.

    tell : is told, in a line each, what was in a folder before, or is missing there

    Returns
    -------
    what `out` holds

    Raises
    ------
    InputError
        When a folder holds no measurements or a link, when suites differ in what
        measurements depend on, when `out` is one of the folders, lies in one or holds
        one, holds a run or something foreign, or its disk is full. `out` is then as it
        was.

    """
    for source in sources:
        _refuse_nested(source, out)
    read = {source: _read(source, tell) for source in dict.fromkeys(sources)}
    refuse_foreign(out)
    _refuse_run(out)
    before = [out] if _journal(out).exists() else []
    folders = [*before, *read]
    paths = {str(folder): folder / "suite.toml" for folder in folders}
    suites = {name: read_stored(path) for name, path in paths.items() if path.exists()}
    suite = as_toml(united(suites))
    for folder in folders:
        check_copies(folder)
    with report_full_disk(out), locked(out):
        union = _Union()
        for folder in before:
            for record in read_journal(folder):
                union.add(record)
        for source, records in read.items():
            if again := sum(map(union.add, records)):
                tell(f"{source}: {again} of {len(records)} {_AGAIN}")
        for source, records in read.items():
            _copy_solutions(source, out, records, tell)
        merge_copies(list(read), out, tell)
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
    """Read a folder; what has no session yet gets one, after its first measurement."""
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
    """Refuse to write into a folder that is read, or beside what is read in ours."""
    here, there = out.resolve(), source.resolve()
    if here == there:
        raise InputError(
            f"--out {out} is one of the folders to merge; expected another one"
        )
    for inner, outer in ((here, there), (there, here)):
        if outer in inner.parents:
            raise InputError(
                f"--out {out}: {inner} lies inside of {outer}; expected a folder apart "
                "from those to merge"
            )


def _refuse_run(out: Path) -> None:
    """Refuse to add to a folder that a run wrote: it would be neither."""
    if not out.is_dir():
        return
    refuse_links(out)
    others = [p.name for p in (out / "journal").glob("*.jsonl") if p != _journal(out)]
    if others:
        raise InputError(
            f"{out} holds measurements of a run (journal/{min(others)}); expected a "
            "new folder, or one that was merged before; choose another --out"
        )


def _copy_solutions(
    source: Path, out: Path, records: Sequence[Record], tell: Callable[[str], None]
) -> None:
    digests = {d for r in records for d in (r.vectors, r.fields) if d is not None}
    lost = [d for d in sorted(digests) if not copy_stored(source, out, d)]
    if lost:
        tell(f"{source}: {len(lost)} of {len(digests)} solutions are not in vectors/")


def _copy_environments(
    folders: Sequence[Path],
    out: Path,
    records: Iterable[Record],
    tell: Callable[[str], None],
) -> None:
    """Keep every environment under its digest; the first is environment.json, too."""
    kept: list[Mapping[str, Any]] = []
    for digest in dict.fromkeys(r.environment for r in records):
        found = _environment(folders, digest)
        if found is None:
            tell(f"no folder holds the environment {digest}")
            continue
        keep_environment(out, digest, {k: v for k, v in found.items() if k != "digest"})
        kept.append(found)
    if kept:
        text = json.dumps(kept[0], indent=1) + "\n"
        replace_file(out / "environment.json", text.encode())


def _environment(folders: Sequence[Path], digest: str) -> Mapping[str, Any] | None:
    for folder in folders:
        with suppress(InputError):
            return environment_of(folder, digest)
    return None
