"""Access to stored measurements, for repetition and for rebuilding the cases."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from mortarbench.harness.errors import InputError, some
from mortarbench.harness.names import CaseId, assemble, unbuilt
from mortarbench.harness.plugin import Case, Family, Reference
from mortarbench.harness.record import Record
from mortarbench.harness.results.folder import environment_of


def find_record(folder: Path, name: str, records: Sequence[Record]) -> Record:
    """Return the record of a measurement in a result folder.

    name : a run_id, or `Record.identity` if several sessions contain the run_id, or the
        first digits of either

    Raises
    ------
    InputError
        If there is no such record, or there are several.

    """
    found = [r for r in records if name in (r.run_id, r.identity)]
    found = found or [
        r for r in records if r.run_id.startswith(name) or r.identity.startswith(name)
    ]
    if len(found) == 1:
        return found[0]
    if found:
        raise InputError(
            f"{folder} contains {len(found)} measurements whose run_id begins with "
            f"{name!r} ({some(sorted(r.identity for r in found))}); give more digits, "
            "or SESSION-RUN_ID"
        )
    near = get_close_matches(name, [r.run_id for r in records], n=1, cutoff=0.0)
    hint = f"; the nearest is {near[0]}" if near else ""
    raise InputError(f"unknown run_id {name!r} in {folder}{hint}")


def case_of(record: Record, families: Mapping[str, Family]) -> CaseId:
    """Return the case of a record; raise `InputError` if its family is unknown."""
    if record.family not in families:
        raise InputError(f"unknown family {record.family!r}")
    family = families[record.family]
    return assemble(record.family, family, record.params, record.form)


def plugins_needed(environment: Mapping[str, Any]) -> str:
    """Return a hint that a measurement needs plug-ins, for a message, or ""."""
    plugins = environment.get("plugins")
    named = plugins if isinstance(plugins, list | Mapping) else ()
    options = " ".join(f"--plugin {name}" for name in named)
    return f"; it was measured with plug-ins: add {options}" if options else ""


def rebuild(
    r: Record, folder: Path, families: Mapping[str, Family], reference: Reference
) -> Case:
    """Build the case of a record again.

    Raises
    ------
    InputError
        If the family is unknown or raises an exception.

    """
    try:
        name = case_of(r, families)
    except InputError as e:
        with suppress(InputError):
            e = InputError(
                f"{e}{plugins_needed(environment_of(folder, r.environment))}"
            )
        raise e from None
    try:
        return name.build(reference)
    except (Exception, SystemExit) as e:  # raised by code of the family
        raise InputError(unbuilt(r.case, e)) from None
