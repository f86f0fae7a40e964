"""Suites in TOML: cases, solvers, repeats, limits and tolerances of a run."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from mortarbench.harness import checked
from mortarbench.harness.distributed.mpi import ranks_asked
from mortarbench.harness.errors import InputError, shown, unknown
from mortarbench.harness.files.reading import MAX_TOML_MIB, read_text, read_toml, toml
from mortarbench.harness.names import CaseId
from mortarbench.harness.plugin import Family, Solver
from mortarbench.harness.registry import SolverSpec, resolve
from mortarbench.harness.suite.parameter_grid import Growth, expand_problems

DEFAULTS: Mapping[str, Any] = {
    "tolerances": [1e-6],
    "repeats": 3,
    "time_limit": 60,
    "memory_limit": 4096,
    "accuracy": None,
    "null_arm": None,
    "ranks": [1],
    "max_cases": 100_000,
}
_SUITE_KEYS = ("name", *DEFAULTS, "solvers", "problems")
_NAME = re.compile(r"[\w.-]*\w[\w.-]*")
_SOLVER_KEYS = ("name", "label", "options")
#: End of the label of the second copy of a solver in an A/A comparison (``null_arm``).
NULL_SUFFIX = " (A/A)"


def _between(key: str, value: Any) -> float | None:
    """Check that `value` is None or strictly between 0 and 1, and return it."""
    if value is None:
        return None
    if not checked.is_number(value) or not 0 < value < 1:
        raise InputError(f"{key} = {shown(value)}; expected a number between 0 and 1")
    return float(value)


#: Functions that check the values of keys with a number.
_NUMBERS: Mapping[str, Callable[[str, Any], float | None]] = {
    "repeats": checked.at_least_one,
    "time_limit": checked.positive,
    "memory_limit": checked.positive,
    "accuracy": _between,
}


def _most_cases(table: Mapping[str, Any]) -> int:
    return checked.at_least_one("max_cases", table["max_cases"], most=10**9)


class Group(NamedTuple):
    """The cases of one block: a single case, or the steps of a sequence."""

    cases: tuple[CaseId, ...]
    mode: str  #: value of `harness.record.Record.mode` for these cases


@dataclass(frozen=True, kw_only=True)
class Suite:
    """A suite, which specifies a run: every solver on every case at every tolerance."""

    name: str
    tolerances: tuple[float, ...]
    repeats: int
    time_limit: float  #: time limit of a measurement, s
    memory_limit: float  #: memory limit of a measurement, MiB
    solvers: tuple[SolverSpec, ...]  #: solvers with distinct labels
    cases: tuple[CaseId, ...]  #: distinct cases, solved without results of other cases
    text: str  #: TOML text of the suite, including the limits that apply
    #: sequences, each a tuple of its steps in order
    sequences: tuple[tuple[CaseId, ...], ...] = ()
    #: positions of cases in series of growing sizes, by name of the case
    growing: Mapping[str, Growth] = field(default_factory=dict)
    #: tolerance of the verdicts; None for the tolerance that is passed to the solver
    accuracy: float | None = None
    every: frozenset[str] = frozenset()  #: names of all cases, regardless of ``--case``

    @property
    def groups(self) -> tuple[Group, ...]:
        """Groups of cases that form a block: single cases, followed by sequences."""
        return (
            *(Group((case,), "cold") for case in self.cases),
            *(Group(steps, "sequence") for steps in self.sequences),
        )

    @property
    def names(self) -> tuple[CaseId, ...]:
        """All cases: single cases, then the steps of each sequence."""
        return tuple(case for group in self.groups for case in group.cases)


def load_suite(
    path: Path, families: Mapping[str, Family], solvers: Mapping[str, Solver]
) -> Suite:
    """Read a suite from a file, and check all of its values.

    Raises
    ------
    InputError
        If a value is invalid; the message states the file, the key and valid values.

    """
    text = read_text(path, "a TOML file", MAX_TOML_MIB)
    return parse_suite(text, f"{path}", path.parent, families, solvers)


def parse_suite(
    text: str,
    where: str,
    folder: Path,
    families: Mapping[str, Family],
    solvers: Mapping[str, Solver],
) -> Suite:
    """Parse the TOML of a suite, and check all of its values.

    where : origin of the text, for messages
    folder : folder of the suite, see `expand_problems`

    Raises
    ------
    InputError
        If a value is invalid; the message states the key and valid values.

    """
    with checked.located(where):
        table = {**DEFAULTS, **toml(text)}
        checked.only_keys(table, _SUITE_KEYS)
        for key in ("name", "solvers", "problems"):
            if key not in table:
                raise InputError(f"{key} is missing")
        if not _NAME.fullmatch(checked.text("name", table["name"])):
            raise InputError(
                f"name = {shown(table['name'])} is not a valid folder name; "
                "expected letters, digits, '.', '-' and '_'"
            )
        problems = expand_problems(
            table["problems"], families, folder, _most_cases(table)
        )
        numbers: dict[str, Any] = {
            key: check(key, table[key]) for key, check in _NUMBERS.items()
        }
        specs = _solvers(table["solvers"], solvers)
        cases, sequences = problems.cold, problems.sequences
        specs = _on_ranks(specs, table, solvers)
        every = frozenset(case.name for group in (cases, *sequences) for case in group)
        return Suite(
            name=table["name"],
            tolerances=_tolerances(table["tolerances"]),
            text=text,
            solvers=_with_null(specs, table["null_arm"]),
            cases=cases,
            every=every,
            sequences=sequences,
            growing=problems.growing,
            **numbers,
        )


def name_in(text: str) -> str:
    """Return the name in the TOML of a suite, or "" if it is missing or invalid."""
    with suppress(InputError):
        name = toml(text).get("name")
        if isinstance(name, str) and _NAME.fullmatch(name):
            return name
    return ""


def read_stored(path: Path) -> dict[str, Any]:
    """Read the suite of a result folder, and check only the types of its values.

    Names and ranges are not checked, since another version may have written the suite,
    or the suite may need a plug-in.

    Raises
    ------
    InputError
        If a value has the wrong type; the message states the file and the value.

    """
    table = read_toml(path, "the suite of a result folder")
    try:
        for key in ("tolerances", "ranks"):
            numbers = checked.any_list(key, table.get(key, []))
            if not all(map(_is_finite, numbers)):
                raise InputError(f"{key} = {shown(numbers)}; expected numbers")
        for key in ("max_cases", *_NUMBERS):
            if key in table and not _is_finite(table[key]):
                raise InputError(f"{key} = {shown(table[key])}; expected a number")
        for key in ("name", "null_arm"):
            if key in table:
                checked.text(key, table[key])
        for i, entry in enumerate(
            checked.any_list("solvers", table.get("solvers", []))
        ):
            with checked.located(f"solvers[{i}]"):
                _spec(entry)
        for block in checked.any_list("problems", table.get("problems", [])):
            checked.table("problems", block, instead="tables")
    except InputError as e:
        raise InputError(f"{path} is not a suite that a run wrote: {e}") from None
    return table


def _is_finite(value: Any) -> bool:
    return checked.is_number(value) and abs(value) <= sys.float_info.max


def suite_text(suite: Mapping[str, Any]) -> str:
    """Return a suite as TOML, with one line per key.

    Raises
    ------
    InputError
        If a value, such as None, cannot be written as TOML.

    >>> print(suite_text({"name": "demo", "tolerances": [1e-6]}), end="")
    name = "demo"
    tolerances = [1e-06]

    """
    lines = [f"{_toml_key(k)} = {_toml_value(str(k), v)}" for k, v in suite.items()]
    return "\n".join(lines) + "\n"


def _toml_key(key: object) -> str:
    if not isinstance(key, str):
        raise InputError(f"key {shown(key)}; expected a string")
    return json.dumps(key) if re.search(r"[^\w-]|^$", key, re.ASCII) else key


def _toml_value(where: str, value: Any) -> str:
    """Return a value as TOML on one line; NumPy arrays and ranges become lists.

    where : path of the value, for messages
    """
    if hasattr(value, "tolist"):
        value = value.tolist()
    match value:
        case bool():  # before int, since bool is a subclass of int
            return str(value).lower()
        case int() | float():
            return repr(value)
        # JSON strings are valid TOML strings except in two cases, which are avoided
        # here: JSON does not escape DEL, and its ASCII form splits characters beyond 16
        # bits into surrogate pairs.
        case str() | Path():
            return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")
        case Mapping():
            pairs = [
                f"{_toml_key(k)} = {_toml_value(f'{where}.{k}', v)}"
                for k, v in value.items()
            ]
            return f"{{ {', '.join(pairs)} }}" if pairs else "{}"
        case list() | tuple() | range():
            entries = [_toml_value(f"{where}[{i}]", v) for i, v in enumerate(value)]
            return f"[{', '.join(entries)}]"
    raise InputError(
        f"{where} = {shown(value)}; expected a string, a number, true or false, a "
        "list or a dict; leave out keys without a value"
    )


def solvers_by_label(text: str) -> dict[str, SolverSpec]:
    """Return the specs of the solvers in the TOML of a suite by label.

    The names and options are not looked up in a registry.
    """
    table = toml(text)
    specs = tuple(map(_spec, checked.filled_list("solvers", table.get("solvers"))))
    return {spec.label: spec for spec in _with_null(specs, table.get("null_arm"))}


def steps_up_to(
    text: str, name: CaseId, families: Mapping[str, Family]
) -> tuple[CaseId, ...]:
    """Return the steps of a sequence from its first case to the case `name`, inclusive.

    text : TOML of the suite

    Raises
    ------
    InputError
        If no sequence contains the case.

    """
    table = {**DEFAULTS, **toml(text)}
    problems = expand_problems(
        table.get("problems"), families, Path(), _most_cases(table)
    )
    for steps in problems.sequences:
        if name in steps:
            return steps[: steps.index(name) + 1]
    raise InputError("the suite has no sequence with that case")


def limits(text: str) -> tuple[float, float]:
    """Return the time limit in s and the memory limit in MiB from a suite's TOML."""
    table = {**DEFAULTS, **toml(text)}
    time_limit, memory_limit = (
        checked.positive(key, table[key]) for key in ("time_limit", "memory_limit")
    )
    return time_limit, memory_limit


def _solvers(entries: object, registry: Mapping[str, Solver]) -> tuple[SolverSpec, ...]:
    specs: dict[str, SolverSpec] = {}
    for i, entry in enumerate(checked.filled_list("solvers", entries)):
        with checked.located(f"solvers[{i}]"):
            spec = _spec(entry)
            if spec.label in specs:
                raise InputError(
                    f"label {shown(spec.label)} is used twice; expected different "
                    "labels"
                )
            resolve(spec, registry)
        specs[spec.label] = spec
    return tuple(specs.values())


def _on_ranks(
    specs: tuple[SolverSpec, ...],
    table: Mapping[str, Any],
    registry: Mapping[str, Solver],
) -> tuple[SolverSpec, ...]:
    """Return specs of each solver for every number of ranks in the suite.

    A solver that needs the entries of P is returned for a single rank: ranks apply P
    together, but do not assemble it.
    """
    ranks = checked.filled_list("ranks", table["ranks"])
    counts = [ranks_asked(n, "ranks") for n in ranks]
    if len(set(counts)) < len(counts):
        raise InputError(f"ranks = {shown(counts)}; expected distinct numbers")
    if counts == [1]:
        return specs
    able = {s.label: _accepts_operators(resolve(s, registry)) for s in specs}
    if not any(able.values()):
        raise InputError(
            f"ranks = {shown(counts)}: every solver needs the entries of P; expected "
            "one that needs products only, or no ranks"
        )
    return tuple(
        spec.on(n) for spec in specs for n in (counts if able[spec.label] else [1])
    )


def _accepts_operators(solver: Solver) -> bool:
    """Return True if a solver accepts a QP whose P is an operator."""
    import numpy as np
    from scipy.sparse.linalg import aslinearoperator

    from mortarbench.harness.qp import QP

    tiny = QP.from_arrays(np.eye(2), np.zeros(2), lb=np.zeros(2))
    return solver.declines(replace(tiny, P=aslinearoperator(np.eye(2)))) is None


def _spec(entry: object) -> SolverSpec:
    if isinstance(entry, str):
        return SolverSpec(name=entry, label=entry)
    table = checked.table("entry", entry, instead="a name or a table")
    checked.only_keys(table, _SOLVER_KEYS)
    if "name" not in table:
        raise InputError("name is missing")
    name = checked.text("name", table["name"])
    return SolverSpec(
        name=name,
        label=checked.text("label", table.get("label", name)),
        options=checked.table("options", table.get("options", {})),
    )


def _with_null(specs: tuple[SolverSpec, ...], label: object) -> tuple[SolverSpec, ...]:
    """Append a second copy of the solver with this label, for an A/A comparison."""
    if label is None:
        return specs
    by_label = {spec.label: spec for spec in specs}
    if (label := checked.text("null_arm", label)) not in by_label:
        raise unknown("null_arm", label, by_label)
    copy = replace(by_label[label], label=f"{label}{NULL_SUFFIX}", role="null")
    return (*specs, copy)


def _tolerances(value: object) -> tuple[float, ...]:
    numbers = checked.filled_list("tolerances", value)
    if not all(checked.is_number(n) and 0 < n < 1 for n in numbers) or len(
        set(numbers)
    ) < len(numbers):
        raise InputError(
            f"tolerances = {shown(value)}; expected distinct numbers between 0 and 1"
        )
    return tuple(map(float, numbers))
