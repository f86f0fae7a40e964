"""Suites: which cases, which solvers, how often and within which limits; from TOML."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

from mortarbench.harness import checked
from mortarbench.harness.distributed.mpi import ranks_asked
from mortarbench.harness.errors import InputError, shown, unknown
from mortarbench.harness.files.reading import MAX_TOML_MIB, read_text, read_toml, toml
from mortarbench.harness.names import CaseId
from mortarbench.harness.plugin import Family, Solver
from mortarbench.harness.record import TIGHTENING
from mortarbench.harness.registry import SolverSpec, resolve
from mortarbench.harness.suite.parameter_grid import planned

DEFAULTS: Mapping[str, Any] = {
    "tolerances": [1e-6],
    "repeats": 3,
    "time_limit": 60,
    "memory_limit": 4096,
    "precision": None,
    "max_repeats": 30,
    "budget": 600,
    "accuracy": None,
    "null_arm": None,
    "tighten": [0],
    "ranks": [1],
    "copies": False,
    "max_cases": 100_000,
}
_SUITE_KEYS = ("name", *DEFAULTS, "solvers", "problems")
_NAME = re.compile(r"[\w.-]*\w[\w.-]*")
_SOLVER_KEYS = ("name", "label", "options")
NULL = " (A/A)"  #: after the label of a solver that is measured once more


def _between(key: str, value: Any) -> float | None:
    """Take nothing, or a number between 0 and 1."""
    if value is None:
        return None
    if not checked.is_number(value) or not 0 < value < 1:
        raise InputError(f"{key} = {shown(value)}; expected a number between 0 and 1")
    return float(value)


#: checks of the keys that are numbers
_NUMBERS: Mapping[str, Callable[[str, Any], float | None]] = {
    "repeats": checked.at_least_one,
    "time_limit": checked.positive,
    "memory_limit": checked.positive,
    "precision": _between,
    "max_repeats": checked.at_least_one,
    "budget": checked.positive,
    "accuracy": _between,
}


def _most_cases(table: Mapping[str, Any]) -> int:
    return checked.at_least_one("max_cases", table["max_cases"], most=10**9)


class Group(NamedTuple):
    """What is measured together: one case, or a sequence."""

    cases: tuple[CaseId, ...]
    mode: str  #: of its records


@dataclass(frozen=True, kw_only=True)
class Suite:
    """What one run measures: every solver on every case at every tolerance."""

    name: str
    tolerances: tuple[float, ...]
    repeats: int
    time_limit: float  #: s per measurement
    memory_limit: float  #: MiB per measurement
    solvers: tuple[SolverSpec, ...]  #: of distinct labels
    cases: tuple[CaseId, ...]  #: all distinct; those that are solved cold
    text: str  #: the TOML as read, but with the limits that hold
    sequences: tuple[tuple[CaseId, ...], ...] = ()  #: each: its steps in order
    #: each sequence is driven once with each: θ of `harness.record.Record.tighten`
    tighten: tuple[float, ...] = (0.0,)
    precision: float | None = None
    """Go on beyond `repeats` until every ratio to the fastest is known so well."""
    max_repeats: int = 30  #: where there is a precision to reach
    budget: float = 600.0  #: s of measured time per case and tolerance, likewise
    accuracy: float | None = None  #: judge answers at this, whatever was asked for
    every: frozenset[str] = frozenset()  #: names of the cases, where these are some

    @property
    def groups(self) -> tuple[Group, ...]:
        """What one block is made of: a single case, or the steps of a sequence."""
        return (
            *(Group((case,), "cold") for case in self.cases),
            *(
                Group(steps, f"{TIGHTENING}{theta:g}" if theta else "sequence")
                for steps in self.sequences
                for theta in self.tighten
            ),
        )

    @property
    def names(self) -> tuple[CaseId, ...]:
        """Every case, cold or in a sequence."""
        return tuple(case for group in self.groups for case in group.cases)


def load_suite(
    path: Path, families: Mapping[str, Family], solvers: Mapping[str, Solver]
) -> Suite:
    """Read a suite and check all of it: nothing is left to fail during the run.

    Raises
    ------
    InputError
        With the file and the place in it, and what would be right.

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
    """Parse the TOML of a suite and check all of it.

    where : name of the text in messages
    folder : where relative paths of the suite start

    Raises
    ------
    InputError
        With the place in it, and what would be right.

    """
    with checked.located(where):
        table = {**DEFAULTS, **toml(text)}
        checked.only_keys(table, _SUITE_KEYS)
        for key in ("name", "solvers", "problems"):
            if key not in table:
                raise InputError(f"{key} is missing")
        if not _NAME.fullmatch(checked.text("name", table["name"])):
            raise InputError(
                f"name = {shown(table['name'])} is no name of a folder; "
                "expected letters, digits, '.', '-' and '_'"
            )
        cases, sequences = planned(
            table["problems"], families, folder, _most_cases(table)
        )
        numbers: dict[str, Any] = {
            key: check(key, table[key]) for key, check in _NUMBERS.items()
        }
        asked = _solvers(table["solvers"], solvers)
        asked = _on_ranks(asked, table, solvers, sequences)
        every = frozenset(case.name for group in (cases, *sequences) for case in group)
        return Suite(
            name=table["name"], tolerances=_tolerances(table["tolerances"]), text=text,
            solvers=_with_null(asked, table["null_arm"]), cases=cases, every=every,
            sequences=sequences, tighten=_tightening(table, sequences), **numbers,
        )  # fmt: skip


def name_in(text: str) -> str:
    """Return the name in the TOML of a suite; empty where `parse_suite` refuses it."""
    with suppress(InputError):
        name = toml(text).get("name")
        if isinstance(name, str) and _NAME.fullmatch(name):
            return name
    return ""


def read_stored(path: Path) -> dict[str, Any]:
    """Read the suite of a result folder, and check the types of its values.

    Solvers, families and ranges are not: another version, or a plug-in, may know them.

    Raises
    ------
    InputError
        With the file and the first value of another type than a run writes.

    """
    table = read_toml(path, "the suite of a result folder")
    try:
        for key in ("tolerances", "tighten", "ranks"):
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
        raise InputError(f"{path} is no suite that a run wrote: {e}") from None
    return table


def _is_finite(value: Any) -> bool:
    return checked.is_number(value) and abs(value) <= sys.float_info.max


def suite_text(suite: Mapping[str, Any]) -> str:
    """Write a suite as TOML, a line per key.

    Raises
    ------
    InputError
        When it holds what TOML cannot, such as None.

    """
    lines = [f"{_toml_key(k)} = {_toml_value(str(k), v)}" for k, v in suite.items()]
    return "\n".join(lines) + "\n"


def _toml_key(key: object) -> str:
    if not isinstance(key, str):
        raise InputError(f"key {shown(key)}; expected a text")
    return json.dumps(key) if re.search(r"[^\w-]|^$", key, re.ASCII) else key


def _toml_value(where: str, value: Any) -> str:
    """Write a value as TOML, on one line; arrays of numpy and ranges as lists."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    match value:
        case bool():
            return str(value).lower()
        case int() | float():
            return repr(value)
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
        f"{where} = {shown(value)}; expected a text, a number, true or false, a list "
        "or a dict; leave out keys without a value"
    )


def asked_solvers(text: str) -> dict[str, SolverSpec]:
    """Read from a suite's TOML what solvers it asks for, by label, unresolved."""
    table = toml(text)
    specs = tuple(map(_spec, checked.filled_list("solvers", table.get("solvers"))))
    return {spec.label: spec for spec in _with_null(specs, table.get("null_arm"))}


def steps_up_to(
    text: str, name: CaseId, families: Mapping[str, Family]
) -> tuple[CaseId, ...]:
    """Read from a suite's TOML the steps of a sequence that lead to one of them.

    Raises
    ------
    InputError
        When no sequence has it.

    """
    table = {**DEFAULTS, **toml(text)}
    _, sequences = planned(table.get("problems"), families, Path(), _most_cases(table))
    for steps in sequences:
        if name in steps:
            return steps[: steps.index(name) + 1]
    raise InputError("the suite has no sequence with that case")


def limits(text: str) -> tuple[float, float]:
    """Read the limits of a measurement from a suite's TOML, s and MiB."""
    table = {**DEFAULTS, **toml(text)}
    time_limit, memory_limit = (
        checked.positive(key, table[key]) for key in ("time_limit", "memory_limit")
    )
    return time_limit, memory_limit


def _solvers(entries: object, registry: Mapping[str, Solver]) -> tuple[SolverSpec, ...]:
    found: dict[str, SolverSpec] = {}
    for i, entry in enumerate(checked.filled_list("solvers", entries)):
        with checked.located(f"solvers[{i}]"):
            spec = _spec(entry)
            if spec.label in found:
                raise InputError(
                    f"label {shown(spec.label)} is used twice; expected a label of its "
                    "own"
                )
            resolve(spec, registry)
        found[spec.label] = spec
    return tuple(found.values())


def _on_ranks(
    specs: tuple[SolverSpec, ...],
    table: Mapping[str, Any],
    registry: Mapping[str, Solver],
    sequences: object,
) -> tuple[SolverSpec, ...]:
    """Ask every solver that can for each number of ranks; others run on one.

    With `copies`, beside several ranks as many independent solves are asked for. What a
    solver carries through a sequence lies in one process, so these are refused.
    """
    ranks, copies = table["ranks"], table["copies"]
    counts = [ranks_asked(n, "ranks") for n in checked.filled_list("ranks", ranks)]
    if not isinstance(copies, bool):
        raise InputError(f"copies = {shown(copies)}; expected true or false")
    if copies and counts == [1]:
        raise InputError(
            "copies = true: what copies reach is compared with ranks; expected several "
            "of these, such as ranks = [1, 2]"
        )
    if len(set(counts)) < len(counts):
        raise InputError(f"ranks = {shown(counts)}; expected distinct numbers")
    if counts != [1] and sequences:
        raise InputError(
            f"ranks = {shown(counts)}: one process drives a sequence; expected "
            "problems without sequence, or no ranks"
        )
    able = {s.label: getattr(resolve(s, registry), "on_ranks", False) for s in specs}
    if counts != [1] and not any(able.values()):
        raise InputError(
            f"ranks = {shown(counts)}: none of the solvers runs on several; expected "
            "one that does, or no ranks"
        )
    found = []
    for spec in specs:
        of_spec = counts if able[spec.label] else [1]
        found += [spec.on(n) for n in of_spec]
        found += [spec.copies(n) for n in of_spec if copies and n > 1]
    return tuple(found)


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
    """Add the solver of that label once more, as a null arm."""
    if label is None:
        return specs
    known = {spec.label: spec for spec in specs}
    if (label := checked.text("null_arm", label)) not in known:
        raise unknown("null_arm", label, known)
    return (*specs, replace(known[label], label=f"{label}{NULL}", role="null"))


def _tightening(table: Mapping[str, Any], sequences: object) -> tuple[float, ...]:
    """Read how sequences tighten; refuse that where it means nothing."""
    thetas = checked.filled_list("tighten", table["tighten"])
    if not all(checked.is_number(t) and 0 <= t < 1 for t in thetas) or len(
        set(thetas)
    ) < len(thetas):
        raise InputError(
            f"tighten = {shown(thetas)}; expected distinct numbers from 0 (each step "
            "to the tolerance) to below 1"
        )
    if any(thetas) and not sequences:
        raise InputError(
            f"tighten = {shown(thetas)}: no problems are a sequence; expected sequence "
            "= KEY in one of them"
        )
    if any(thetas) and table["accuracy"] is not None:
        raise InputError(
            f"tighten = {shown(thetas)}: every answer is judged at accuracy = "
            f"{shown(table['accuracy'])}; expected only one of the two"
        )
    return tuple(map(float, thetas))


def _tolerances(value: object) -> tuple[float, ...]:
    numbers = checked.filled_list("tolerances", value)
    if not all(checked.is_number(n) and 0 < n < 1 for n in numbers) or len(
        set(numbers)
    ) < len(numbers):
        raise InputError(
            f"tolerances = {shown(value)}; expected distinct numbers between 0 and 1"
        )
    return tuple(map(float, numbers))
