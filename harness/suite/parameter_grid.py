"""The tables under ``problems`` of a suite: grids of cases, and sequences of them."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from glob import escape, glob
from itertools import product
from math import prod
from pathlib import Path, PurePath
from typing import Any

from mortarbench.harness import checked
from mortarbench.harness.errors import PLUGINS, InputError, shown, some, unknown
from mortarbench.harness.names import CaseId, assemble
from mortarbench.harness.plugin import Family

_PROBLEM_KEYS = ("family", "forms", "params", "zip", "sequence")


def expand_problems(
    blocks: object, families: Mapping[str, Family], folder: Path, most: int
) -> tuple[tuple[CaseId, ...], tuple[tuple[CaseId, ...], ...]]:
    """All cold cases in the order written, and all sequences of cases.

    A case that two blocks share is kept once. A sequence are the cases that differ in
    its key only, and in those zipped with it, in the order of their values.

    folder : of the suite; a path that leads nowhere from here is sought there
    most : cases that the blocks may span in all
    """
    cold: dict[str, CaseId] = {}
    sequences: dict[str, tuple[CaseId, ...]] = {}
    for block in _blocks(blocks, families, folder, most):
        if not block.along:
            for case in block.cases:
                cold.setdefault(case.name, case)
            continue
        steps: dict[str, list[CaseId]] = {}
        for case in block.cases:
            rest = {k: v for k, v in case.params.items() if k not in block.along}
            steps.setdefault(f"{case.form} {rest}", []).append(case)
        sequences |= {repr(cases): tuple(cases) for cases in steps.values()}
    return tuple(cold.values()), tuple(sequences.values())


@dataclass(frozen=True, eq=False, kw_only=True)
class _Block:
    cases: list[CaseId]
    along: tuple[str, ...]  #: the keys of a sequence; none where cases are cold


def _blocks(
    blocks: object, families: Mapping[str, Family], folder: Path, most: int
) -> Iterator[_Block]:
    """Read the tables under problems, one by one."""
    spanned = 0
    for i, block in enumerate(checked.filled_list("problems", blocks)):
        with checked.located(f"problems[{i}]"):
            table = checked.table("entry", block)
            checked.only_keys(table, _PROBLEM_KEYS)
            if "family" not in table:
                raise InputError("family is missing")
            name = checked.text("family", table["family"])
            if name not in families:
                raise unknown("family", name, families, more=PLUGINS)
            family = families[name]
            params = checked.table("params", table.get("params", {}))
            for key in params:
                if key not in family.defaults:
                    raise unknown("key", key, family.defaults, where=name)
            over = _along(table.get("sequence"), params)
            forms = checked.filled_list("forms", table.get("forms", list(family.forms)))
            if family.path_suffix is not None and "path" in params:
                params = {**params, "path": _expanded(params["path"], folder, family)}
            axes = _axes(params, table.get("zip", []))
            along = next((tuple(axis[0]) for axis in axes if over in axis[0]), ())
            spanned += prod(map(len, axes)) * len(forms)
            if spanned > most:
                raise InputError(
                    f"the grid spans {spanned} cases; expected at most {most} in all; "
                    f"take fewer values, or set max_cases = {spanned} in the suite"
                )
            cases = [
                assemble(
                    family,
                    _located(point, folder, family),
                    checked.text("forms", form),
                )
                for point in _points(axes)
                for form in forms
            ]
            yield _Block(cases=cases, along=along)


def _expanded(paths: object, folder: Path, family: Family) -> object:
    """Write out the shell patterns among paths: the files that match, sorted."""
    listed = paths if isinstance(paths, list) else [paths]
    if not any(_is_pattern(path, folder, family) for path in listed):
        return paths
    found: list[object] = []
    for path in listed:
        if _is_pattern(path, folder, family):
            found += _matching(str(path), folder, family)
        else:
            found.append(path)
    return found


def _is_pattern(path: object, folder: Path, family: Family) -> bool:
    """Whether a path has the signs of a pattern, and is no file's name as it is."""
    if not isinstance(path, str) or not set("*?[") & set(path):
        return False
    if os.path.exists(path) or (folder / path).exists():
        return False
    return not _copied(escape(path), family)


def _matching(pattern: str, folder: Path, family: Family) -> list[str]:
    """List the files that match from here, or else from the folder of the suite.

    Files that are missing here count where the result folder knows of them.
    """
    missing = {p for p in _copied(pattern, family) if not os.path.lexists(p)}
    if found := sorted({*filter(os.path.isfile, glob(pattern)), *missing}):
        return found
    beside = glob(os.path.join(escape(str(folder)), pattern))
    if found := sorted(map(os.path.relpath, filter(os.path.isfile, beside))):
        return found
    raise InputError(
        f"params.path = {shown(pattern)} matches no file; expected a pattern of files, "
        "from here or from the folder of the suite"
    )


def _copied(pattern: str, family: Family) -> list[str]:
    """List paths that the result folder knows and whose last parts match a pattern."""
    if not PurePath(pattern).parts:
        return []
    return [path for path in family.copied_paths() if PurePath(path).match(pattern)]


def _located(
    point: dict[str, object], folder: Path, family: Family
) -> dict[str, object]:
    """Take a path that leads nowhere from here to be relative to the suite.

    A file that is at neither place may have travelled with the results, under the path
    that the suite had led to then.
    """
    match point:
        case {"path": str(text)} if text and not Path(text).is_file():
            if (beside := folder / text).is_file():
                return {**point, "path": os.path.relpath(beside)}
            copied = _copied(escape(text), family)
            if text not in copied and len(copied) == 1:
                return {**point, "path": copied[0]}
    return point


def _along(key: object, params: Mapping[str, Any]) -> str | None:
    """Check the key that a sequence runs along."""
    if key is None:
        return None
    values = params.get(checked.text("sequence", key))
    if not isinstance(values, list) or len(values) < 2:
        lists = [k for k, v in params.items() if isinstance(v, list)]
        hint = f"; there are {some(lists)}" if lists else ""
        raise InputError(
            f"sequence = {shown(key)} is no list in params; expected the key whose "
            f"values are the steps{hint}"
        )
    return str(key)


def _axes(table: Mapping[str, Any], groups: object) -> list[list[dict[str, object]]]:
    """List what each axis of a grid runs through; zipped keys run together."""
    columns = {
        key: checked.filled_list(f"params.{key}", v) if isinstance(v, list) else [v]
        for key, v in table.items()
    }
    zipped: dict[str, list[str]] = {}
    for group in checked.any_list("zip", groups):
        for key in checked.filled_list("zip", group):
            if (
                not isinstance(table.get(checked.text("zip", key)), list)
                or key in zipped
            ):
                raise InputError(
                    f"zip: {shown(key)} is no list in params, or is paired twice; "
                    'expected groups of such keys, like [["Nr", "Nh"]]'
                )
            zipped[key] = group
        if len({len(columns[key]) for key in group}) > 1:
            lengths = ", ".join(f"{key} has {len(columns[key])}" for key in group)
            raise InputError(f"zip: {lengths} values; expected equally many")
    axes = []
    for key in columns:
        together = zipped.get(key, [key])
        if key == min(together, key=list(columns).index):
            rows = zip(*(columns[k] for k in together), strict=True)
            axes.append([dict(zip(together, row, strict=True)) for row in rows])
    return axes


def _points(axes: Sequence[list[dict[str, object]]]) -> Iterator[dict[str, object]]:
    """Span the grid of some axes, the first one slowest."""
    for point in product(*axes):
        yield {k: v for part in point for k, v in part.items()}
