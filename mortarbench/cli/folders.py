"""Commands on result folders: `validate`, `report`, `replay` and `merge`."""

from __future__ import annotations

from collections.abc import Sequence
from json import dumps
from pathlib import Path
from typing import Any

import mortarbench as mb
from mortarbench.harness.errors import say
from mortarbench.registries import Registries


def validate(registries: Registries, *, json: bool = False, **arguments: Any) -> int:
    """Compare the answers in a result folder with reference solutions.

    Exit code 1: a claim is refuted, or answers contradict each other.

    json : print JSON
    """
    result = mb.validate(**arguments, progress=say, registries=registries)
    if json:
        print(dumps(result.to_dict(), allow_nan=False))
    else:
        print(result, *result.pages, sep="\n")
    return 0 if result.agreed else 1


def report(
    _: Registries,
    folder: str,
    others: Sequence[str] = (),
    *,
    verbose: bool = False,
    json: bool = False,
    **arguments: Any,
) -> int:
    """Write the report on a result folder, or on changes between result folders.

    Exit codes: 1 if a condition of ``--fail-on`` is met, 2 if it cannot be told.

    verbose : print the paths of all written files, not only the path of the page
    json : print JSON
    """
    result = mb.report(folder, *others, **arguments)
    if json:
        print(dumps(result.to_dict(), allow_nan=False))
    else:
        paths = result.files if verbose else _main_paths(result.files)
        failed = [f"failed on {', '.join(result.failed_on)}"] * bool(result.failed_on)
        print(*result.said, *paths, *failed, sep="\n")
    return result.code


def replay(registries: Registries, *, json: bool = False, **arguments: Any) -> int:
    """Repeat one stored measurement and compare it with the old one.

    Exit code 1: the new verdict or the QP differs.

    json : print JSON
    """
    result = mb.replay(**arguments, registries=registries)
    print(dumps(result.to_dict()) if json else result)
    return 0 if result.reproduced else 1


def merge(_: Registries, *, folders: Sequence[str] = (), **arguments: Any) -> int:
    """Merge several result folders into one.

    Duplicate measurements are stored once; environments are kept separate.
    """
    results = mb.merge(*folders, **arguments, tell=say)
    environments = len({r.environment for r in results.records})
    print(results)
    print(f"{results.folder}: {len(results)} measurements", end="")
    print(f", {environments} environments" if environments > 1 else "")
    return 0


def _main_paths(files: Sequence[Path]) -> list[Path]:
    """Return the HTML pages, else the Markdown pages, else the folders of the files."""
    for suffix in (".html", ".md"):
        if pages := [file for file in files if file.suffix == suffix]:
            return pages
    return list(dict.fromkeys(file.parent for file in files))
