"""Expansion of the ``problems`` of a suite into single cases and sequences of cases."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from glob import escape, glob
from itertools import chain, product
from math import prod
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from msgspec import Meta, Struct

from mortarbench.harness.checked import located
from mortarbench.harness.errors import PLUGINS, InputError, shown, some, unknown
from mortarbench.harness.names import CaseId, assemble, split_row
from mortarbench.harness.plugin import Family

Text = Annotated[str, Meta(pattern=r"^[^\x00-\x1f\x7f]+$")]
Texts = Annotated[tuple[Text, ...], Meta(min_length=1)]


class Problem(
    Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True
):
    """Entry of ``problems`` in a suite: a grid of cases of one family."""

    family: Text
    forms: Texts | None = None  #: None for all forms of the family
    params: dict[str, Any] = {}  #: value of each key, or list of its values
    zip: tuple[Texts, ...] = ()  #: groups of keys whose lists vary together
    sequence: Text | None = None  #: key whose values are the steps of a sequence


class Group(NamedTuple):
    """The cases of one block: a single case, or the steps of a sequence."""

    cases: tuple[CaseId, ...]
    mode: str  #: value of `harness.record.Record.mode` for these cases


@dataclass(frozen=True, eq=False, kw_only=True)
class Cases:
    """All cases of a suite, without duplicates."""

    cold: tuple[CaseId, ...]  #: cases solved without results of other cases
    #: steps of each sequence, in order
    sequences: tuple[tuple[CaseId, ...], ...] = ()

    @property
    def groups(self) -> tuple[tuple[Group, ...], ...]:
        """Groups of cases that form a block: single cases, followed by sequences.

        If the steps of a sequence are also measured cold, they form one cold block, so
        that both ways differ only in the reuse of results. Their groups stand together,
        because the blocks of each repeat follow each other.
        """
        cold = {case.name for case in self.cold}
        twice = [s for s in self.sequences if cold.issuperset(c.name for c in s)]
        steps = {case.name for sequence in twice for case in sequence}
        return (
            *((Group((c,), "cold"),) for c in self.cold if c.name not in steps),
            *(
                (*[Group(s, "cold")] * (s in twice), Group(s, "sequence"))
                for s in self.sequences
            ),
        )

    @property
    def all(self) -> tuple[CaseId, ...]:
        """All cases: single cases, then the steps of each sequence."""
        groups = chain.from_iterable(self.groups)
        return tuple(case for group in groups for case in group.cases)

    def selected(self, patterns: Sequence[str]) -> Cases:
        """Return the cases that match a pattern, and the sequences with such a case.

        patterns : shell globs over canonical names

        Raises
        ------
        InputError
            If a pattern matches no case.

        """
        names = [case.name for case in self.all]
        chosen: set[str] = set()
        for pattern in patterns:
            matches = [name for name in names if fnmatchcase(name, pattern)]
            if not matches:
                raise InputError(
                    f"cases {pattern!r} matches none of the {len(names)} cases of the "
                    f"suite; its cases are {some(names)}"
                )
            chosen.update(matches)
        return replace(
            self,
            cold=tuple(c for c in self.cold if c.name in chosen),
            sequences=tuple(
                s for s in self.sequences if any(c.name in chosen for c in s)
            ),
        )


def expand_problems(
    problems: Sequence[Problem],
    families: Mapping[str, Family],
    folder: Path,
    most: int,
) -> Cases:
    """Return all cases of a suite: single cases and sequences.

    The first key of a grid varies slowest, and forms vary fastest. The cases of a
    sequence differ only in one key and in the keys that are zipped with it.

    folder : folder of the suite, to which relative paths refer if they do not exist in
        the working directory
    most : largest total number of cases

    Raises
    ------
    InputError
        If an entry is invalid or there are too many cases; the message names the entry.

    """
    cold: dict[str, CaseId] = {}
    sequences: dict[tuple[str, ...], tuple[CaseId, ...]] = {}
    # number of cases, checked before the cases are created: a grid may span billions
    count = 0
    for number, problem in enumerate(problems):
        with located(f"problems[{number}]"):
            if problem.family not in families:
                raise unknown("family", problem.family, families, more=PLUGINS)
            family = families[problem.family]
            forms = problem.forms or family.forms
            axes, steps = _axes(problem, _params(problem, folder, family))
            count += prod(map(len, axes)) * len(forms) * len(steps)
            if count > most:
                raise InputError(
                    f"the grid spans {count} cases; expected at most {most} in all; "
                    f"take fewer values, or set max_cases = {count} in the suite"
                )
            for rows in product(*axes):
                point = {key: value for row in rows for key, value in row.items()}
                for form in forms:
                    group = tuple(
                        assemble(problem.family, family, point | step, form)
                        for step in steps
                    )
                    if problem.sequence is None:
                        cold[group[0].name] = group[0]
                    else:
                        sequences[tuple(case.name for case in group)] = group
    return Cases(cold=tuple(cold.values()), sequences=tuple(sequences.values()))


def _params(problem: Problem, folder: Path, family: Family) -> dict[str, Any]:
    """Return the keys that an entry sets, with the files that its paths denote."""
    if family.path_suffix is None or "path" not in problem.params:
        return problem.params
    path = _expanded(problem.params["path"], folder, family)
    return {**problem.params, "path": path}


def _axes(
    problem: Problem, params: Mapping[str, Any]
) -> tuple[list[list[dict[str, Any]]], list[dict[str, Any]]]:
    """Return the axes of a grid without that of the sequence, and the latter.

    An axis is a list of dicts from keys to values. Keys that are zipped belong to the
    axis of the first of them; any other key has its own axis. Without a sequence, its
    axis is a single empty dict.
    """
    lists = {key: value for key, value in params.items() if isinstance(value, list)}
    keys = [key for group in problem.zip for key in group]
    lengths = [{len(lists.get(key, ())) for key in group} for group in problem.zip]
    if len(set(keys)) < len(keys) or any(len(n) > 1 or 0 in n for n in lengths):
        raise InputError(
            f"zip = {shown([*map(list, problem.zip)])}; expected groups of different "
            'keys whose lists in params have equal lengths, such as [["Nr", "Nh"]]'
        )
    sequence = problem.sequence
    if sequence is not None and len(lists.get(sequence, ())) < 2:
        hint = f"; the lists are {some(lists)}" if lists else ""
        raise InputError(
            f"sequence = {shown(sequence)} is not a list in params; expected the key "
            f"whose values are the steps{hint}"
        )
    axes: dict[tuple[str, ...], list[dict[str, Any]]] = {}
    for key in params:
        together = next((group for group in problem.zip if key in group), (key,))
        columns = [lists.get(k, [params[k]]) for k in together]
        if not columns[0]:
            raise InputError(f"params.{key} is empty; expected at least one entry")
        rows = zip(*columns, strict=True)
        axes[together] = [dict(zip(together, row, strict=True)) for row in rows]
    steps = next((group for group in axes if sequence in group), ())
    along = axes.pop(steps, [{}])
    return [*axes.values()], along


def _expanded(paths: object, folder: Path, family: Family) -> object:
    """Replace paths by the files that they denote, and files by their problems."""
    expanded: list[object] = []
    for path in paths if isinstance(paths, list) else [paths]:
        if isinstance(path, str) and path:
            for file in _files(path, folder):
                expanded += family.problems_in(file)
        else:
            expanded.append(path)
    return expanded if len(expanded) != 1 or isinstance(paths, list) else expanded[0]


def _files(path: str, folder: Path) -> list[str]:
    """Return the files that a path or a shell pattern denotes, sorted by name.

    Files are searched relative to the working directory, then relative to the folder of
    the suite.
    """
    file, _ = split_row(path)
    row = path.removeprefix(file)
    for base in ("", str(folder)):
        exact = os.path.join(base, file)
        pattern = os.path.join(escape(base), file)
        files = [exact] if os.path.isfile(exact) else sorted(glob(pattern))
        if files := [f for f in files if os.path.isfile(f)]:
            return [f"{os.path.relpath(f) if base else f}{row}" for f in files]
    if not set("*?[") & set(path):
        return [path]
    raise InputError(
        f"params.path = {shown(path)} matches no file; expected a pattern relative "
        "to the working directory or to the folder of the suite"
    )
