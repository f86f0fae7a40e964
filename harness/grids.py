"""The tables under ``problems`` of a suite: grids of cases, and sequences of them."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import product
from pathlib import Path

from harness import checked
from harness.errors import PLUGINS, InputError, some, unknown
from harness.names import CaseName, assemble, canonical
from harness.plugin import Family

_PROBLEM_KEYS = ("family", "forms", "params", "zip", "sequence")


def cold_cases(
    blocks: object, families: Mapping[str, Family], folder: Path
) -> tuple[CaseName, ...]:
    """All cold cases in the order written; one that two blocks share is kept once.

    folder : of the suite; a path that leads nowhere from here is sought there
    """
    found: dict[str, CaseName] = {}
    for block in _blocks(blocks, families, folder):
        if block.along is None:
            for case in block.cases:
                found.setdefault(canonical(case, block.family), case)
    return tuple(found.values())


def sequences(
    blocks: object, families: Mapping[str, Family], folder: Path
) -> tuple[tuple[CaseName, ...], ...]:
    """Group the cases that differ in the key of their sequence only, in its order.

    folder : as for `cold_cases`
    """
    found: dict[str, tuple[CaseName, ...]] = {}
    for block in _blocks(blocks, families, folder):
        if block.along is None:
            continue
        steps: dict[str, list[CaseName]] = {}
        for case in block.cases:
            rest = {k: v for k, v in case.params.items() if k != block.along}
            steps.setdefault(f"{case.form} {rest}", []).append(case)
        found |= {repr(cases): tuple(cases) for cases in steps.values()}
    return tuple(found.values())


@dataclass(frozen=True, eq=False, kw_only=True)
class _Block:
    family: Family
    cases: list[CaseName]
    along: str | None  #: the key of a sequence


def _blocks(
    blocks: object, families: Mapping[str, Family], folder: Path
) -> Iterator[_Block]:
    """Read the tables under problems, one by one."""
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
            params = table.get("params", {})
            along = _along(table.get("sequence"), params)
            forms = checked.filled_list("forms", table.get("forms", list(family.forms)))
            cases = [
                assemble(family, _located(point, folder), checked.text("forms", form))
                for point in _grid(params, table.get("zip", []))
                for form in forms
            ]
            yield _Block(family=family, cases=cases, along=along)


def _located(point: dict[str, object], folder: Path) -> dict[str, object]:
    """Take a path that leads nowhere from here to be relative to the suite."""
    match point:
        case {"path": str(text)} if (beside := folder / text).is_file():
            if not Path(text).is_file():
                return {**point, "path": os.path.relpath(beside)}
    return point


def _along(key: object, params: object) -> str | None:
    """Check the key that a sequence runs along."""
    if key is None:
        return None
    params = checked.table("params", params)
    values = params.get(checked.text("sequence", key))
    if not isinstance(values, list) or len(values) < 2:
        lists = [k for k, v in params.items() if isinstance(v, list)]
        hint = f"; there are {some(lists)}" if lists else ""
        raise InputError(
            f"sequence = {key!r} is no list in params; expected the key whose values "
            f"are the steps{hint}"
        )
    return str(key)


def _grid(params: object, groups: object) -> list[dict[str, object]]:
    """Span the grid of `params`, first key slowest; zipped keys run together."""
    table = checked.table("params", params)
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
                    f"zip: {key!r} is no list in params, or is paired twice; "
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
    return [
        {k: v for part in point for k, v in part.items()} for point in product(*axes)
    ]
