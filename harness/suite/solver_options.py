"""Options of solvers: several values of an option span a grid of labelled solvers.

Values come from a suite, from ``--option [SOLVER.]KEY=VALUE``, or from a Python caller.
A value is converted to the type of the option, which is the annotation of the dataclass
field. If the field has no annotation, or its annotation is Any or object, the type of
the default is used.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import product
from math import prod
from numbers import Integral, Real
from types import NoneType
from typing import Any

import msgspec

from mortarbench.harness.checked import located
from mortarbench.harness.errors import InputError, shown, unknown
from mortarbench.harness.plugin import Solver
from mortarbench.harness.registry import (
    SolverSpec,
    accepts_any,
    check_name,
    known_options,
    option_types,
    option_value,
    resolve,
)

#: End of the label of the second copy of a solver in an A/A comparison (``null_arm``).
NULL_SUFFIX = " (A/A)"
_KEY = re.compile(r"(?:[^=]+\.)?[^\W\d]\w*")
_PLAIN = (bool, Real, str, NoneType)  #: types of values that Python callers may pass
_MAX_VARIANTS = 1000  #: largest number of variants of one solver


def parse_options(texts: Iterable[str]) -> dict[str, list[Any]]:
    """Parse texts ``[SOLVER.]KEY=VALUE``, and return the values by ``[SOLVER.]KEY``.

    Raises
    ------
    InputError
        If a text does not have this form.

    >>> parse_options(["max_iter=50", "osqp.rho=0.1", "max_iter=200"])
    {'max_iter': ['50', '200'], 'osqp.rho': ['0.1']}

    """
    options: dict[str, list[Any]] = {}
    for text in texts:
        key, _, value = text.partition("=")
        if not value or not _KEY.fullmatch(key):
            raise InputError(
                f"--option {shown(text)}; expected [SOLVER.]KEY=VALUE, such as "
                "max_iter=50"
            )
        options.setdefault(key, []).append(value)
    return options


def listed_options(options: object) -> dict[str, list[Any]]:
    """Return the values by key of options from a Python caller, as `parse_options`.

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
    values: dict[str, list[Any]] = {}
    for key, value in options.items():
        if not isinstance(key, str) or not _KEY.fullmatch(key):
            raise InputError(
                f"options: {shown(key)} is not a name; expected one such as max_iter"
            )
        values[key] = list(value) if isinstance(value, list | tuple) else [value]
        if not values[key] or not all(isinstance(v, _PLAIN) for v in values[key]):
            raise InputError(
                f"options: {key} = {shown(value)}; expected a number, string, True, "
                "False or None, or a list of these"
            )
    return values


def selected(
    specs: Sequence[SolverSpec], names: Sequence[str], solvers: Mapping[str, Solver]
) -> tuple[SolverSpec, ...]:
    """Return the solvers with these labels, or with these names in a registry.

    The second copy of a selected solver in an A/A comparison is also returned.

    Raises
    ------
    InputError
        If a name is neither a label nor in `solvers`.

    """
    known = {spec.label: spec for spec in specs}
    for name in names:
        if name not in known:
            check_name(name, solvers, labels=known)
            known[name] = SolverSpec(name=name, label=name)
    twins = [f"{name}{NULL_SUFFIX}" for name in names]
    return tuple(known[n] for n in dict.fromkeys([*names, *twins]) if n in known)


def sweep(
    specs: Sequence[SolverSpec],
    given: Mapping[str, Sequence[Any]],
    registry: Mapping[str, Solver],
) -> tuple[SolverSpec, ...]:
    """Return a variant of each solver for every combination of option values.

    If a solver lacks some of the options, only its existing options are varied. A
    solver without any of the options is returned unchanged.

    given : values by ``KEY``, or by ``SOLVER.KEY`` for the solvers with this label or
        name

    Raises
    ------
    InputError
        If no solver has one of the options, or if a solver refuses a value.

    """
    used: set[str] = set()
    variants: list[SolverSpec] = []
    with located("--option"):
        for spec in specs if given else ():
            configured = resolve(spec, registry)
            axes = {}
            for full, values in given.items():
                solver, _, key = full.rpartition(".")
                is_meant = solver in (spec.label, spec.name) or len(specs) == 1
                # a library without a list of its settings has every option
                if solver in ("", spec.label, spec.name) and (
                    key in known_options(configured, key)
                    or (is_meant and accepts_any(configured))
                ):
                    axes[key] = list(values)
                    used.add(full)
            options = {**spec.options, **axes}
            variants += grid(replace(spec, options=options), registry)
        known = {
            f"{spec.label}.{key}" if "." in full else key
            for full in given
            for spec in specs
            for key in known_options(resolve(spec, registry))
        }
        for full in given.keys() - used:
            raise unknown("option", full, known)
        return distinct(variants or specs)


def distinct(specs: Iterable[SolverSpec]) -> tuple[SolverSpec, ...]:
    """Return the solvers; raise InputError if two of them have the same label."""
    labels: dict[str, SolverSpec] = {}
    for spec in specs:
        if spec is not labels.setdefault(spec.label, spec):
            raise InputError(
                f"label {shown(spec.label)} is used twice; expected different labels"
            )
    return tuple(labels.values())


def grid(spec: SolverSpec, registry: Mapping[str, Solver]) -> Iterator[SolverSpec]:
    """Yield a variant of a solver for every combination of the lists in its options.

    A list spans a grid unless the list is itself a value of the type of the option.
    The label of a variant contains its values, as in ``LABEL max_iter=50``.

    Raises
    ------
    InputError
        If the solver or an option is unknown, or if the solver refuses a value.

    """
    solver = resolve(replace(spec, options={}), registry)
    axes = {
        key: value
        for key, value in spec.options.items()
        if isinstance(value, list)
        and (key in known_options(solver, key) or accepts_any(solver))
        and not _is_value(value, solver, key)
    }
    if (count := prod(map(len, axes.values()))) > _MAX_VARIANTS or not count:
        raise InputError(
            f"options span {count} variants of {spec.name}; expected 1 to "
            f"{_MAX_VARIANTS}"
        )
    null = NULL_SUFFIX if spec.role == "null" else ""
    for values in product(*axes.values()):
        options = {
            key: option_value(f"{spec.name}: {key}", value, solver, key)
            for key, value in zip(axes, values, strict=True)
        }
        texts = [f"{key}={_text(value)}" for key, value in options.items()]
        label = " ".join([spec.label.removesuffix(null), *texts]) + null
        variant = replace(spec, label=label, options={**spec.options, **options})
        resolve(variant, registry)
        yield variant


def _is_value(value: object, solver: Solver, key: str) -> bool:
    """Return True if a list is itself a value of an option."""
    for kind in option_types(solver, key):
        with suppress(msgspec.ValidationError, TypeError):
            msgspec.convert(value, kind)
            return True
    return False


def _text(value: object) -> str:
    """Return a value as a text without blanks, since labels are split at blanks."""
    match value:
        case None | bool():
            return str(value).lower()
        case Integral():
            return repr(int(value))
        case Real():
            return repr(float(value))
    return "_".join(str(value).split())
