"""Expansion of the ``problems`` of a suite into single cases and sequences of cases."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from glob import escape, glob
from itertools import cycle, product
from math import prod
from pathlib import Path, PurePath
from typing import Any

from mortarbench.harness import checked
from mortarbench.harness.errors import PLUGINS, InputError, shown, some, unknown
from mortarbench.harness.names import CaseId, assemble, split_row
from mortarbench.harness.plugin import Family

_PROBLEM_KEYS = ("family", "forms", "params", "zip", "sequence", "growing")


@dataclass(frozen=True)
class Growth:
    """Position of a case in a series of growing sizes."""

    smaller: str  #: name of the next smaller case of the series; empty for the smallest
    warm_up: CaseId  #: the same case with the default size of the family


@dataclass(frozen=True, eq=False, kw_only=True)
class Problems:
    """All cases of a suite."""

    cold: tuple[CaseId, ...]  #: cases solved without results of other cases
    sequences: tuple[tuple[CaseId, ...], ...]  #: steps of each sequence, in order
    growing: Mapping[str, Growth]  #: position of each case in a series of growing sizes


def expand_problems(
    blocks: object, families: Mapping[str, Family], folder: Path, most: int
) -> Problems:
    """Return all cases of a suite: single cases, sequences, series of growing sizes.

    A case that occurs in several blocks is returned once. The cases of a sequence, or
    of a series of growing sizes, differ only in the key of the sequence or series and
    in keys that are zipped with this key. The cases have the order of the values of the
    key.

    blocks : value of ``problems`` in the suite
    folder : folder of the suite, to which relative paths refer if they do not exist in
        the working directory
    most : largest total number of cases

    Raises
    ------
    InputError
        If a block is invalid or there are too many cases; the message names the block.

    """
    cold: dict[str, CaseId] = {}
    sequences: dict[str, tuple[CaseId, ...]] = {}
    growing: dict[str, Growth] = {}
    for block in _blocks(blocks, families, folder, most):
        if block.kind != "sequence":
            for case in block.cases:
                cold.setdefault(case.name, case)
        steps: dict[str, list[CaseId]] = {}
        for case, given in zip(block.cases, block.given, strict=True):
            rest = {k: v for k, v in given.items() if k not in block.along}
            steps.setdefault(f"{case.form} {rest}", []).append(case)
            if block.kind == "growing":
                smaller = steps[f"{case.form} {rest}"][-2:-1]
                growing[case.name] = Growth(
                    smaller[0].name if smaller else "",
                    assemble(case.family, rest, case.form),
                )
        if block.kind == "sequence":
            sequences |= {repr(cases): tuple(cases) for cases in steps.values()}
    return Problems(
        cold=tuple(cold.values()),
        sequences=tuple(sequences.values()),
        growing=growing,
    )


@dataclass(frozen=True, eq=False, kw_only=True)
class _Block:
    cases: list[CaseId]
    given: list[dict[str, object]]  #: keys that the suite sets, for each case
    kind: str  #: "sequence", "growing" or, for single cases, ""
    #: keys that vary in the sequence or series; () for single cases
    along: tuple[str, ...]


def _blocks(
    blocks: object, families: Mapping[str, Family], folder: Path, most: int
) -> Iterator[_Block]:
    """Check the entries of ``problems``, and yield their cases as blocks."""
    # number of cases, checked before the cases are created: a grid may span billions
    count = 0
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
            kind, along_key = _along(table, params)
            forms = checked.filled_list("forms", table.get("forms", list(family.forms)))
            if family.path_suffix is not None and "path" in params:
                params = {**params, "path": _expanded(params["path"], folder, family)}
            axes = _axes(params, table.get("zip", []))
            along = next((tuple(axis[0]) for axis in axes if along_key in axis[0]), ())
            count += prod(map(len, axes)) * len(forms)
            if count > most:
                raise InputError(
                    f"the grid spans {count} cases; expected at most {most} in all; "
                    f"take fewer values, or set max_cases = {count} in the suite"
                )
            given = [point for point in _points(axes) for _ in forms]
            cases = [
                assemble(family, point, checked.text("forms", form))
                for point, form in zip(given, cycle(forms), strict=False)
            ]
            yield _Block(cases=cases, given=given, kind=kind, along=along)


def _expanded(paths: object, folder: Path, family: Family) -> object:
    """Replace shell patterns among paths by the matching files, sorted by name.

    A file with several problems is replaced by the paths of its problems.
    """
    expanded: list[object] = []
    for path in paths if isinstance(paths, list) else [paths]:
        if _is_pattern(path, folder, family):
            files: Sequence[object] = _matching(str(path), folder, family)
        else:
            files = [_located({"path": path}, folder, family)["path"]]
        for file in files:
            expanded += family.problems_in(file) if isinstance(file, str) else [file]
    return expanded if len(expanded) != 1 or isinstance(paths, list) else expanded[0]


def _is_pattern(path: object, folder: Path, family: Family) -> bool:
    """Return True if a path contains wildcards and no file has exactly this path."""
    if not isinstance(path, str) or not set("*?[") & set(path):
        return False
    if os.path.exists(path) or (folder / path).exists():
        return False
    return not _copied(escape(path), family)


def _matching(pattern: str, folder: Path, family: Family) -> list[str]:
    """Return the files that match a pattern, relative to the working directory.

    The result includes files that are missing but have a copy in the result folder. If
    there is no match, the pattern is interpreted relative to the folder of the suite.
    """
    missing = {p for p in _copied(pattern, family) if not os.path.lexists(p)}
    if paths := sorted({*filter(os.path.isfile, glob(pattern)), *missing}):
        return paths
    beside = glob(os.path.join(escape(str(folder)), pattern))
    if paths := sorted(map(os.path.relpath, filter(os.path.isfile, beside))):
        return paths
    raise InputError(
        f"params.path = {shown(pattern)} matches no file; expected a pattern relative "
        "to the working directory or to the folder of the suite"
    )


def _copied(pattern: str, family: Family) -> list[str]:
    """Return the listed paths of copied files whose last components match a pattern."""
    if not PurePath(pattern).parts:
        return []
    return [path for path in family.copied_paths() if PurePath(path).match(pattern)]


def _located(
    point: dict[str, object], folder: Path, family: Family
) -> dict[str, object]:
    """Return the keys of a case, with a path that leads to its file.

    If the path does not exist relative to the working directory, the path is
    interpreted relative to the folder of the suite. If the file is also missing in this
    folder, and the result folder lists exactly one copied file that matches, the listed
    path is returned.
    """
    match point:
        case {"path": str(text)} if text:
            file, _ = split_row(text)
            row = text.removeprefix(file)
            if Path(file).is_file():
                return point
            if (beside := folder / file).is_file():
                return {**point, "path": f"{os.path.relpath(beside)}{row}"}
            copied = _copied(escape(file), family)
            if file not in copied and len(copied) == 1:
                return {**point, "path": f"{copied[0]}{row}"}
    return point


def _along(table: Mapping[str, Any], params: Mapping[str, Any]) -> tuple[str, str]:
    """Return the kind of a block and the key that varies; "", "" for single cases."""
    kinds = [kind for kind in ("sequence", "growing") if kind in table]
    if not kinds:
        return "", ""
    if len(kinds) > 1:
        raise InputError("sequence and growing are both set; expected only one of them")
    (kind,) = kinds
    key = table[kind]
    values = params.get(checked.text(kind, key))
    if not isinstance(values, list) or len(values) < 2:
        lists = [k for k, v in params.items() if isinstance(v, list)]
        hint = f"; the lists are {some(lists)}" if lists else ""
        raise InputError(
            f"{kind} = {shown(key)} is not a list in params; expected the key whose "
            f"values are the {'steps' if kind == 'sequence' else 'sizes'}{hint}"
        )
    return kind, str(key)


def _axes(table: Mapping[str, Any], groups: object) -> list[list[dict[str, object]]]:
    """Return the axes of a grid, each a list of dicts from keys to values.

    Keys that are zipped belong to the same axis; any other key has its own axis.
    """
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
                    f"zip: {shown(key)} is not a list in params, or is paired twice; "
                    'expected groups of such keys, like [["Nr", "Nh"]]'
                )
            zipped[key] = group
        if len({len(columns[key]) for key in group}) > 1:
            lengths = ", ".join(f"{key} has {len(columns[key])}" for key in group)
            raise InputError(f"zip: {lengths} values; expected lists of equal length")
    axes = []
    for key in columns:
        together = zipped.get(key, [key])
        if key == min(together, key=list(columns).index):
            rows = zip(*(columns[k] for k in together), strict=True)
            axes.append([dict(zip(together, row, strict=True)) for row in rows])
    return axes


def _points(axes: Sequence[list[dict[str, object]]]) -> Iterator[dict[str, object]]:
    """Yield the points of a grid as dicts; the first axis varies slowest."""
    for point in product(*axes):
        yield {k: v for part in point for k, v in part.items()}
