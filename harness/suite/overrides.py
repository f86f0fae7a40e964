"""A suite narrowed, as the options of the command line say."""

from __future__ import annotations

import re
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
from mortarbench.harness.suite.solver_options import sweep
from mortarbench.harness.suite.suite import NULL_SUFFIX, Suite


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
    options: Mapping[str, Sequence[str]] | None = None,
) -> Suite:
    """Narrow a suite as the options of the command line say.

    solvers : labels of the suite to keep, or names of the registry to add
    cases : what to keep: shell globs over canonical names, or names
    options : of the solvers, as texts; several values sweep

    Raises
    ------
    InputError
        For an unknown solver, a pattern that matches nothing, a value out of range.

    """
    changes: dict[str, Any] = {}
    if solvers:
        chosen = {spec.label: spec for spec in suite.solvers}
        known = {label: resolve(spec, registry) for label, spec in chosen.items()}
        for name in solvers:
            if name not in chosen:
                chosen[name] = SolverSpec(name=name, label=name)
                with checked.located("--solver"):
                    resolve(chosen[name], {**known, **registry})
        kept = dict.fromkeys(solvers)
        null = [
            n for n in chosen if n not in kept and n.removesuffix(NULL_SUFFIX) in kept
        ]
        changes["solvers"] = tuple(chosen[name] for name in (*kept, *null))
    if options:
        asked = changes.get("solvers", suite.solvers)
        changes["solvers"] = sweep(asked, options, registry)
    if cases:
        changes |= _chosen_cases(suite, cases, families)
    if repeats is not None:
        changes["repeats"] = checked.at_least_one("--repeats", repeats)
    text = suite.text
    for key, limit in (("time_limit", time_limit), ("memory_limit", memory_limit)):
        if limit is not None:
            changes[key] = checked.positive(f"--{key.replace('_', '-')}", limit)
            # Measurements under other limits are other measurements, unlike those of
            # fewer solvers, cases or repeats: they make another suite. In TOML such
            # keys come before those of any table.
            line = f"{key} = {limit!r}"
            if key in toml(text):
                old = rf"^[ \t]*{key}[ \t]*=.*$"
                text = re.sub(old, line, text, count=1, flags=re.MULTILINE)
            else:
                text = f"{line}\n{text}"
    return replace(suite, text=text, **changes)


def _chosen_cases(
    suite: Suite, patterns: Sequence[str], families: Mapping[str, Family]
) -> dict[str, Any]:
    """Keep what matches; of a sequence all or nothing."""
    named = [case.name for case in suite.names]
    kept: set[str] = set()
    for pattern in patterns:
        canonical = pattern
        if not set("*?[") & set(pattern):
            with suppress(InputError):
                canonical = parse(pattern, families).name
        matched = match(canonical, named)
        if not matched:
            raise InputError(
                f"--case {pattern!r} matches none of the {len(named)} cases of suite "
                f"{suite.name!r}; there are {some(named)}"
            )
        kept.update(matched)

    def wanted(case: CaseId) -> bool:
        return case.name in kept

    return {
        "cases": tuple(filter(wanted, suite.cases)),
        "sequences": tuple(s for s in suite.sequences if any(map(wanted, s))),
    }
