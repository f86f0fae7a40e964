"""Options of solvers from the command line: ``KEY=VALUE``, with lists for sweeps.

A value is converted to the type of the option, which is the annotation of the dataclass
field. If the field has no annotation, or its annotation is Any or object, the type of
the default is used.
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
# stricter than int() and float(), which accept 1_0 and digits of other scripts
_NUMBERS = {
    int: (re.compile(r"[+-]?[0-9]+"), "an integer"),
    float: (
        re.compile(r"[+-]?(inf|([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?)"),
        "a number",
    ),
}
_TRUTH = {"true": True, "false": False}
_PLAIN = (bool, Real, str, NoneType)  #: types of values that Python callers may pass
_MAX_VARIANTS = 1000  #: largest number of variants of one solver in a sweep


def parse_options(texts: Iterable[str]) -> dict[str, list[str]]:
    """Parse texts ``KEY=VALUE`` or ``KEY=VALUE,VALUE``, and return the values by key.

    Values of a key that occurs in several texts are joined.

    Raises
    ------
    InputError
        If a text does not have this form.

    >>> parse_options(["max_iter=50,100", "rho=0.1", "max_iter=200"])
    {'max_iter': ['50', '100', '200'], 'rho': ['0.1']}

    """
    options: dict[str, list[str]] = {}
    for text in texts:
        key, equals, values = text.partition("=")
        if not equals or not _KEY.fullmatch(key) or not all(values.split(",")):
            raise InputError(
                f"--option {shown(text)}; expected KEY=VALUE, such as max_iter=50"
            )
        options.setdefault(key, []).extend(values.split(","))
    return options


def options_as_texts(options: Mapping[str, Any]) -> dict[str, list[str]]:
    """Convert options from a Python caller to texts, as on the command line.

    Raises
    ------
    InputError
        If `options` is not a mapping from names to plain values or lists of plain
        values.

    """
    if not isinstance(options, Mapping):
        raise InputError(
            f'options = {shown(options)}; expected a dict such as {{"max_iter": 50}}'
        )
    texts: dict[str, list[str]] = {}
    for key, value in options.items():
        if not isinstance(key, str) or not _KEY.fullmatch(key):
            raise InputError(
                f"options: {shown(key)} is not a name; expected one such as max_iter"
            )
        values = value if isinstance(value, list | tuple) else [value]
        if not values or not all(isinstance(v, _PLAIN) for v in values):
            raise InputError(
                f"options: {key} = {shown(value)}; expected a number, string, True, "
                "False or None, or a list of these"
            )
        texts[key] = [*map(_text, values)]
    return texts


def options_for(
    name: str, texts: Iterable[str], registry: Mapping[str, Solver]
) -> dict[str, Any]:
    """Return the values of the options of one solver by key, from texts ``KEY=VALUE``.

    name : name of the solver in the registry

    Raises
    ------
    InputError
        If an option has several values, is unknown, or has a value that the solver
        refuses.

    """
    options_of_texts = parse_options(texts)
    if not options_of_texts:
        return {}
    with located("--option"):
        for key, values in options_of_texts.items():
            if len(values) > 1:
                raise InputError(
                    f"{key} has {len(values)} values; expected one value, since only "
                    "`run` sweeps options"
                )
        spec = SolverSpec(name=name, label=name)
        single = {key: value for key, (value,) in options_of_texts.items()}
        options = _typed(name, resolve(spec, registry), single)
        resolve(replace(spec, options=options), registry)
    return options


def sweep(
    specs: Sequence[SolverSpec],
    given: Mapping[str, Sequence[str]],
    registry: Mapping[str, Solver],
) -> tuple[SolverSpec, ...]:
    """Return a variant of each solver for every combination of option values.

    The label of a variant contains its values, as in ``LABEL max_iter=50``. If a solver
    lacks some of the options, only its existing options are varied. A solver without
    any of the options is returned unchanged.

    given : values by option

    Raises
    ------
    InputError
        If no solver has one of the options, or if a solver refuses a value.

    """
    if not given:
        return tuple(specs)
    solvers = [resolve(spec, registry) for spec in specs]
    names = {name for solver in solvers for name in options_of(solver)}
    for key in given:
        if key not in names:
            raise unknown("option", key, names, where="--option")
    variants: dict[str, SolverSpec] = {}  # by label
    for spec, solver in zip(specs, solvers, strict=True):
        for options in _combinations(spec.name, solver, given):
            null = NULL_SUFFIX if spec.role == "null" else ""
            label = f"{with_options(spec.label.removesuffix(null), options)}{null}"
            if label in variants:
                raise InputError(
                    f"--option: {label!r} occurs twice; expected distinct values"
                )
            changed = replace(spec, label=label, options={**spec.options, **options})
            with located("--option"):
                resolve(changed, registry)
            variants[label] = changed
    return tuple(variants.values())


def _combinations(
    name: str, solver: Solver, given: Mapping[str, Sequence[str]]
) -> Iterator[dict[str, Any]]:
    axes = {key: given[key] for key in given if key in options_of(solver)}
    if (count := prod(map(len, axes.values()))) > _MAX_VARIANTS:
        raise InputError(
            f"--option spans {count} variants of {name}; expected at most "
            f"{_MAX_VARIANTS}"
        )
    for values in product(*axes.values()):
        with located("--option"):
            yield _typed(name, solver, dict(zip(axes, values, strict=True)))


def _typed(name: str, solver: Solver, texts: Mapping[str, str]) -> dict[str, Any]:
    """Convert the texts of options to the types of the solver's options.

    name : name of the solver, for messages
    """
    defaults, annotated = options_of(solver), option_types(solver)
    values = {}
    for key, text in texts.items():
        if key not in defaults:
            raise unknown("option", key, defaults, where=name)
        kind = annotated.get(key, type(defaults[key]))
        if kind is NoneType:  # without an annotation, a default of None has no type
            kind = bool | int | float | str
        readings = [*_readings(text, kind, defaults[key])]
        if not readings:
            expected = " or ".join(dict.fromkeys(_expected(kind, defaults[key])))
            raise InputError(f"{name}: {key} = {shown(text)}; expected {expected}")
        values[key] = readings[0]
    return values


def with_options(label: str, options: Mapping[str, Any]) -> str:
    """Append options to the label of a solver.

    >>> with_options("LABEL", {"max_iter": 50, "scaling": True})
    'LABEL max_iter=50 scaling=true'

    """
    return " ".join([label, *(f"{k}={_text(v)}" for k, v in options.items())])


def without_options(label: str) -> Iterator[str]:
    """Yield a label, then the label without its last option, last two options, etc.

    >>> list(without_options("LABEL max_iter=50 scaling=true"))
    ['LABEL max_iter=50 scaling=true', 'LABEL max_iter=50', 'LABEL']

    """
    yield label
    while (shorter := re.sub(r" [^\W\d]\w*=\S*$", "", label)) != label:
        yield (label := shorter)


def _text(value: object) -> str:
    """Return a value as a text without blanks, which `_readings` converts back."""
    match value:
        case None | bool():
            return str(value).lower()
        case str():  # replace blanks, since `without_options` splits labels at blanks
            return "_".join(value.split())
        case Integral():  # includes integers of NumPy
            return repr(int(value))
        case Real():
            return repr(float(value))
    return repr(value)


def _readings(text: str, kind: Any, default: object) -> Iterator[Any]:
    """Yield the values of type `kind` that a text may represent.

    default : default of the option; if it is None, "none" represents None
    """
    if text == "none" and default is None:
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


def _expected(kind: Any, default: object) -> Iterator[str]:
    """Yield descriptions of the values that an option may have, for messages."""
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
        yield "a string"
    elif kind is not NoneType:
        yield "a value that only a suite can contain, as `options` of a solver"
    if default is None:
        yield "none"
