"""Changes of a suite by options of the command line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import Any

from mortarbench.harness import checked
from mortarbench.harness.errors import InputError, some
from mortarbench.harness.files.reading import toml
from mortarbench.harness.names import CaseId, match, parse
from mortarbench.harness.plugin import Family, Solver
from mortarbench.harness.registry import SolverSpec, resolve
from mortarbench.harness.suite.solver_options import NULL_SUFFIX, sweep
from mortarbench.harness.suite.suite import Suite, as_toml


def with_overrides(
    suite: Suite,
    families: Mapping[str, Family],
    registry: Mapping[str, Solver],
    *,
    solvers: Sequence[str] = (),
    cases: Sequence[str] = (),
    repeats: int | None = None,
    time_limit: float | None = None,
    memory_limit: float | None = None,
    options: Mapping[str, Sequence[Any]] | None = None,
) -> Suite:
    """Return a suite changed by options of the command line.

    solvers : labels of solvers to select from the suite, or names of solvers in the
        registry to run instead; empty to keep all solvers of the suite
    cases : names of cases to select, or shell globs over canonical names; empty to
        keep all cases
    options : values of solver options, see `sweep`

    Raises
    ------
    InputError
        If a solver is unknown, a pattern matches no case, or a value is out of range.

    """
    changes: dict[str, Any] = {}
    if solvers:
        chosen = {spec.label: spec for spec in suite.solvers}
        resolved = {label: resolve(spec, registry) for label, spec in chosen.items()}
        for name in solvers:
            if name not in chosen:
                chosen[name] = SolverSpec(name=name, label=name)
                with checked.located("--solver"):
                    resolve(chosen[name], {**resolved, **registry})
        selected = dict.fromkeys(solvers)
        # the ratio of an A/A comparison also needs the second copy of a selected solver
        null = [
            name
            for name in chosen
            if name not in selected and name.removesuffix(NULL_SUFFIX) in selected
        ]
        changes["solvers"] = tuple(chosen[name] for name in (*selected, *null))
    if options:
        specs = changes.get("solvers", suite.solvers)
        changes["solvers"] = sweep(specs, options, registry)
    if cases:
        changes |= _chosen_cases(suite, cases, families)
    if repeats is not None:
        changes["repeats"] = checked.at_least_one("--repeats", repeats)
    limits: dict[str, Any] = {
        key: checked.positive(f"--{key.replace('_', '-')}", limit)
        for key, limit in (("time_limit", time_limit), ("memory_limit", memory_limit))
        if limit is not None
    }
    # Results depend on the limits, so a suite with different limits counts as a
    # different suite, and the stored text must contain the limits. Results do not
    # depend on the selection of solvers and cases.
    text = as_toml({**toml(suite.text), **limits}) if limits else suite.text
    return replace(suite, text=text, **changes, **limits)


def _chosen_cases(
    suite: Suite, patterns: Sequence[str], families: Mapping[str, Family]
) -> dict[str, Any]:
    """Return the cases that match a pattern, and the sequences with such a case."""
    names = [case.name for case in suite.names]
    selected: set[str] = set()
    for pattern in patterns:
        canonical = pattern
        if not set("*?[") & set(pattern):
            with suppress(InputError):
                canonical = parse(pattern, families).name
        matches = match(canonical, names)
        if not matches:
            raise InputError(
                f"--case {pattern!r} matches none of the {len(names)} cases of suite "
                f"{suite.name!r}; its cases are {some(names)}"
            )
        selected.update(matches)

    def is_selected(case: CaseId) -> bool:
        return case.name in selected

    return {
        "cases": tuple(filter(is_selected, suite.cases)),
        "sequences": tuple(s for s in suite.sequences if any(map(is_selected, s))),
    }
