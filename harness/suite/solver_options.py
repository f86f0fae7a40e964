"""Options of solvers as the command line gives them: ``KEY=VALUE``, lists for sweeps.

A value is read as the type that the solver declares for the option: the annotation of
the field of its dataclass, or, where that says nothing, the type of its default.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import product
from math import prod
from numbers import Integral, Real
from types import NoneType, UnionType
from typing import Any, Literal, Union, get_args, get_origin

from mortarbench.harness.checked import located
from mortarbench.harness.errors import InputError, shown, unknown
from mortarbench.harness.plugin import Solver
from mortarbench.harness.registry import SolverSpec, option_types, options_of, resolve
from mortarbench.harness.suite.suite import NULL_SUFFIX

_KEY = re.compile(r"[^\W\d]\w*")
_NUMBERS = {
    int: (re.compile(r"[+-]?[0-9]+"), "an integer"),
    float: (
        re.compile(r"[+-]?(inf|([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?)"),
        "a number",
    ),
}  # digits of other scripts and 1_0 are numbers to Python alone
_TRUTH = {"true": True, "false": False}
_PLAIN = (bool, Real, str, NoneType)  #: types of values from a Python program
_MAX_VARIANTS = 1000  #: solvers that a sweep may span


def parse_options(texts: Iterable[str]) -> dict[str, list[str]]:
    """Split ``KEY=VALUE`` or ``KEY=VALUE,VALUE``; of a key given again, go on.

    Raises
    ------
    InputError
        For what is nothing like it, and for a value that is given twice.

    """
    found: dict[str, list[str]] = {}
    for text in texts:
        key, equals, values = text.partition("=")
        if not equals or not _KEY.fullmatch(key) or not all(values.split(",")):
            raise InputError(
                f"--option {shown(text)}; expected KEY=VALUE, such as max_iter=50"
            )
        found.setdefault(key, []).extend(values.split(","))
    return found


def options_as_texts(options: Mapping[str, Any]) -> dict[str, list[str]]:
    """Write options that a Python program gives as the command line does.

    Raises
    ------
    InputError
        When they are no mapping from names to plain values or lists of these.

    """
    if not isinstance(options, Mapping):
        raise InputError(
            f'options = {shown(options)}; expected a dict such as {{"max_iter": 50}}'
        )
    given: dict[str, list[str]] = {}
    for key, value in options.items():
        if not isinstance(key, str) or not _KEY.fullmatch(key):
            raise InputError(
                f"options: {shown(key)} is no name; expected one such as max_iter"
            )
        values = value if isinstance(value, list | tuple) else [value]
        if not values or not all(isinstance(v, _PLAIN) for v in values):
            raise InputError(
                f"options: {key} = {shown(value)}; expected a number, a text, True, "
                "False or None, or a list of these"
            )
        given[key] = [*map(_text, values)]
    return given


def options_for(
    name: str, texts: Iterable[str], registry: Mapping[str, Solver]
) -> dict[str, Any]:
    """Read the options of one solver, each given once, where nothing is swept.

    name : of the solver in the registry

    Raises
    ------
    InputError
        When an option has several values; as `sweep`.

    """
    given = parse_options(texts)
    if not given:
        return {}
    with located("--option"):
        for key, values in given.items():
            if len(values) > 1:
                raise InputError(
                    f"{key} has {len(values)} values; expected one, only `run` sweeps"
                )
        spec = SolverSpec(name=name, label=name)
        one = {key: value for key, (value,) in given.items()}
        options = _typed(name, resolve(spec, registry), one)
        resolve(replace(spec, options=options), registry)
    return options


def sweep(
    specs: Sequence[SolverSpec],
    given: Mapping[str, Sequence[str]],
    registry: Mapping[str, Solver],
) -> tuple[SolverSpec, ...]:
    """Give every solver that has the options each combination of their values.

    Labels tell them apart, as in ``LABEL max_iter=50``. A solver that has some of the
    options takes these; one that has none stays as it is.

    Raises
    ------
    InputError
        When no solver has one of the options, or one refuses a value of it.

    """
    if not given:
        return tuple(specs)
    solvers = [resolve(spec, registry) for spec in specs]
    names = {name for solver in solvers for name in options_of(solver)}
    for key in given:
        if key not in names:
            raise unknown("option", key, names, where="--option")
    found: dict[str, SolverSpec] = {}
    for spec, solver in zip(specs, solvers, strict=True):
        for options in _combinations(spec.name, solver, given):
            null = NULL_SUFFIX if spec.role == "null" else ""
            label = f"{with_options(spec.label.removesuffix(null), options)}{null}"
            if label in found:
                raise InputError(
                    f"--option: {label!r} is asked for twice; expected distinct values"
                )
            changed = replace(spec, label=label, options={**spec.options, **options})
            with located("--option"):
                resolve(changed, registry)
            found[label] = changed
    return tuple(found.values())


def _combinations(
    name: str, solver: Solver, given: Mapping[str, Sequence[str]]
) -> Iterator[dict[str, Any]]:
    own = {key: given[key] for key in given if key in options_of(solver)}
    if (count := prod(map(len, own.values()))) > _MAX_VARIANTS:
        raise InputError(
            f"--option spans {count} variants of {name}; expected at most "
            f"{_MAX_VARIANTS}"
        )
    for values in product(*own.values()):
        with located("--option"):
            yield _typed(name, solver, dict(zip(own, values, strict=True)))


def _typed(name: str, solver: Solver, given: Mapping[str, str]) -> dict[str, Any]:
    """Read the values of options as the types that a solver declares."""
    known, annotated = options_of(solver), option_types(solver)
    values = {}
    for key, text in given.items():
        if key not in known:
            raise unknown("option", key, known, where=name)
        kind = annotated.get(key, type(known[key]))
        if kind is NoneType:  # nothing tells its type
            kind = bool | int | float | str
        read = [*_readings(text, kind, known[key])]
        if not read:
            expected = " or ".join(dict.fromkeys(_expected(kind, known[key])))
            raise InputError(f"{name}: {key} = {shown(text)}; expected {expected}")
        values[key] = read[0]
    return values


def with_options(label: str, options: Mapping[str, Any]) -> str:
    """Write options after the label of a solver: ``LABEL max_iter=50 scaling=true``."""
    return " ".join([label, *(f"{k}={_text(v)}" for k, v in options.items())])


def without_options(label: str) -> Iterator[str]:
    """Give what of a label may be that of a suite: all of it, then less and less."""
    yield label
    while (shorter := re.sub(r" [^\W\d]\w*=\S*$", "", label)) != label:
        yield (label := shorter)


def _text(value: object) -> str:
    """Write a value as one word that is read as the same again."""
    match value:
        case None | bool():
            return str(value).lower()
        case str():
            return "_".join(value.split())
        case Integral():  # of numpy, too
            return repr(int(value))
        case Real():
            return repr(float(value))
    return repr(value)


def _readings(text: str, kind: Any, current: object) -> Iterator[Any]:
    """Give what a text may mean as an option of some type, `current` by default."""
    if text == "none" and current is None:
        yield None
    if get_origin(kind) in (Union, UnionType):
        for part in get_args(kind):
            yield from _readings(text, part, ...)
    elif get_origin(kind) is Literal:
        yield from (value for value in get_args(kind) if text == _text(value))
    elif kind is bool:
        yield from (value for word, value in _TRUTH.items() if word == text.lower())
    elif kind in _NUMBERS:
        if _NUMBERS[kind][0].fullmatch(text):
            yield kind(text)
    elif kind is str:
        yield text


def _expected(kind: Any, current: object) -> Iterator[str]:
    """Name the values that an option may have."""
    if get_origin(kind) in (Union, UnionType):
        for part in get_args(kind):
            yield from _expected(part, ...)
    elif get_origin(kind) is Literal:
        yield from map(_text, get_args(kind))
    elif kind is bool:
        yield from _TRUTH
    elif kind in _NUMBERS:
        yield _NUMBERS[kind][1]
    elif kind is str:
        yield "a text"
    elif kind is not NoneType:
        yield "what only a suite can give, as `options` of a solver"
    if current is None:
        yield "none"
