"""Suites in TOML: cases, solvers, repeats, limits and tolerances of a run."""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta, Struct

from mortarbench.harness.checked import located
from mortarbench.harness.distributed.mpi import ranks_asked
from mortarbench.harness.errors import InputError, shown, unknown
from mortarbench.harness.files.reading import read_toml, toml
from mortarbench.harness.plugin import Family, Solver
from mortarbench.harness.registry import SolverSpec, in_words, resolve
from mortarbench.harness.suite.parameter_grid import (
    Cases,
    Problem,
    Text,
    expand_problems,
)
from mortarbench.harness.suite.solver_options import NULL_SUFFIX, distinct, grid

Positive = Annotated[float, Meta(gt=0, le=sys.float_info.max)]
Fraction = Annotated[float, Meta(gt=0, lt=1)]


class Entry(
    Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True
):
    """Table in ``solvers`` of a suite."""

    name: Text  #: name in the registry
    label: Text | None = None  #: None for the name
    options: dict[str, Any] = {}  #: value of each option, or list of its values


class SuiteFile(
    Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, omit_defaults=True
):
    """Content of a suite, of which only types and ranges have been checked."""

    name: Annotated[str, Meta(pattern=r"^[\w.-]*\w[\w.-]*$")]
    tolerances: Annotated[tuple[Fraction, ...], Meta(min_length=1)] = (1e-6,)
    repeats: Annotated[int, Meta(ge=1, le=1_000_000)] = 3
    time_limit: Positive = 60.0  #: s per measurement
    memory_limit: Positive = 4096.0  #: MiB per measurement
    #: tolerance of the verdicts; None for the tolerance that is passed to the solver
    accuracy: Fraction | None = None
    null_arm: Text | None = None  #: label of the solver that is measured twice
    ranks: Annotated[tuple[int, ...], Meta(min_length=1)] = (1,)
    max_cases: Annotated[int, Meta(ge=1, le=10**9)] = 100_000
    solvers: tuple[Text | Entry, ...] = ()
    problems: tuple[Problem, ...] = ()

    def __post_init__(self) -> None:
        for key in ("tolerances", "ranks"):
            values = getattr(self, key)
            if len(set(values)) < len(values):
                raise ValueError(f"{key} = {values}; expected distinct numbers")

    def specs(self) -> Iterator[SolverSpec]:
        """Yield the solvers; a list among the options of a solver is not expanded."""
        for entry in self.solvers:
            one = Entry(name=entry) if isinstance(entry, str) else entry
            label = one.label or one.name
            yield SolverSpec(name=one.name, label=label, options=one.options)


@dataclass(frozen=True, kw_only=True)
class Suite:
    """A suite, which specifies a run: every solver on every case at every tolerance."""

    file: SuiteFile  #: settings of the run, and the entries that are expanded here
    solvers: tuple[SolverSpec, ...]  #: solvers with distinct labels
    cases: Cases


def load_suite(
    path: Path, families: Mapping[str, Family], solvers: Mapping[str, Solver]
) -> Suite:
    """Read a suite from a file, and check all of its values.

    Raises
    ------
    InputError
        If a value is invalid; the message states the file, the key and valid values.

    """
    file = read_suite(path)
    with located(f"{path}"):
        return expanded(file, path.parent, families, solvers)


def expanded(
    file: SuiteFile,
    folder: Path,
    families: Mapping[str, Family],
    solvers: Mapping[str, Solver],
) -> Suite:
    """Look up the cases and the solvers of a suite.

    folder : folder of the suite, see `expand_problems`

    Raises
    ------
    InputError
        If a value is invalid; the message states the key and valid values.

    """
    for key in ("solvers", "problems"):
        if not getattr(file, key):
            raise InputError(f"{key} is missing or empty; expected a list")
    cases = expand_problems(file.problems, families, folder, file.max_cases)
    return Suite(file=file, solvers=_solvers(file, solvers), cases=cases)


def suite_file(table: Mapping[str, Any]) -> SuiteFile:
    """Check the keys, types and ranges of a suite, and return it.

    Raises
    ------
    InputError
        If a key is unknown or missing, or if a value has the wrong type or is out of
        range; the message states the path of the key, such as ``problems[0].forms``.

    """
    try:
        return msgspec.convert(table, SuiteFile)
    except msgspec.ValidationError as e:
        message, _, path = str(e).partition(" - at `$")
    path = path.removeprefix(".").removesuffix("`")
    quoted = re.findall("`(.*?)`", message)
    if message.startswith("Object contains unknown field"):
        kind = {"": SuiteFile, "s": Entry, "p": Problem}[path[:1]]
        raise unknown("key", quoted[0], kind.__struct_fields__, where=path)
    if message.startswith("Object missing required field"):
        raise InputError(f"{path}{': ' * bool(path)}{quoted[0]} is missing")
    if not path:  # raised by `SuiteFile.__post_init__`
        raise InputError(message)
    value: Any = table
    for name, index in re.findall(r"(\w+)|\[(\d+)\]", path):
        value = value[name] if name else value[int(index)]
    if "regex" in message:
        message = "Expected a nonempty string without control characters"
        if path == "name":
            message = "Expected a folder name of letters, digits, '.', '-' and '_'"
    expected = re.sub("`(.+?)`", lambda m: in_words(m[1].split(" | ")), message)
    expected = expected.partition(", got ")[0].replace("Expected", "expected")
    raise InputError(f"{path} = {shown(value)}; {expected}")


def read_suite(path: Path) -> SuiteFile:
    """Read a suite from a file, without looking up its cases and solvers.

    Raises
    ------
    InputError
        If a key or a value is invalid; the message states the file and the value.

    """
    table = read_toml(path)
    with located(f"{path}"):
        return suite_file(table)


def as_toml(table: Mapping[str, Any]) -> str:
    """Return a suite as TOML, with one line per key.

    Strings, numbers and lists are the same in JSON, and inline tables have another
    separator.

    Raises
    ------
    InputError
        If a value, such as None, cannot be written as TOML.

    >>> print(as_toml({"name": "demo", "tolerances": [1e-6]}), end="")
    name = "demo"
    tolerances = [1e-06]

    """
    lines = []
    for key, value in table.items():
        try:
            text = json.dumps(
                value, ensure_ascii=False, separators=(", ", " = "), default=_plain
            )
            lines.append(f"{key} = {text}\n")
            toml(lines[-1])
        # an AttributeError is raised for other objects
        except (InputError, TypeError, ValueError, AttributeError, RecursionError):
            raise InputError(
                f"{shown(key)[1:-1]} = {shown(value)}; expected a string, a number, "
                "true or false, a list or a dict; leave out keys without a value"
            ) from None
    return "".join(lines)


def _plain(value: Any) -> Any:
    """Return arrays and scalars of NumPy, ranges and paths as plain data for JSON."""
    match value:
        case range():
            return [*value]
        case Path():
            return str(value)
    return value.tolist()


def _solvers(file: SuiteFile, registry: Mapping[str, Solver]) -> tuple[SolverSpec, ...]:
    """Return the solvers of a suite on each number of ranks, with distinct labels.

    A solver that needs the entries of P is returned for a single rank: ranks apply P
    together, but do not assemble it.
    """
    specs: list[SolverSpec] = []
    counts = [ranks_asked(n, "ranks") for n in file.ranks]
    for number, entry in enumerate(file.specs()):
        with located(f"solvers[{number}]"):
            for spec in grid(entry, registry):
                able = counts == [1] or _accepts_operators(resolve(spec, registry))
                specs += map(spec.on, counts if able else [1])
    with located("solvers"):
        distinct(specs)
    if max(counts) > 1 and all(spec.ranks == 1 for spec in specs):
        raise InputError(
            f"ranks = {shown(counts)}: every solver needs the entries of P; expected "
            "one that needs products only, or no ranks"
        )
    if file.null_arm is not None:
        twins = [spec for spec in specs if spec.label == file.null_arm]
        if not twins:
            raise unknown("null_arm", file.null_arm, [spec.label for spec in specs])
        label = f"{file.null_arm}{NULL_SUFFIX}"
        specs.append(replace(twins[0], label=label, role="null"))
    return tuple(specs)


def _accepts_operators(solver: Solver) -> bool:
    """Return True if a solver accepts a QP whose P is an operator."""
    import numpy as np
    from scipy.sparse.linalg import aslinearoperator

    from mortarbench.harness.qp import QP

    tiny = QP.from_arrays(np.eye(2), np.zeros(2), lb=np.zeros(2))
    return solver.declines(replace(tiny, P=aslinearoperator(np.eye(2)))) is None
