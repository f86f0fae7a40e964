"""The command `test-solver`: run the conformance suite on solvers."""

from __future__ import annotations

import fnmatch
import json
from argparse import Namespace
from collections.abc import Collection

from mortarbench.harness import checked
from mortarbench.harness.errors import say
from mortarbench.harness.registry import SolverSpec, check_name, resolve
from mortarbench.registries import Registries


def run(registries: Registries, options: Namespace) -> int:
    """Run all checks; return 1 if a check fails or a solver solves no QP."""
    checked.positive("--time-limit", options.time_limit)
    registries = registries.with_files(options.plugin)
    specs = [
        SolverSpec(name=name, label=name)
        for pattern in options.solver
        for name in _named(pattern, registries.solvers)
    ]
    for spec in specs:
        check_name(spec.name, registries.solvers)
    from mortarbench.harness.conformance.conformance import CHECKS, INVARIANCE_PREFIX
    from mortarbench.harness.conformance.weaknesses import weaknesses_page
    from mortarbench.progress import waiting
    from mortarbench.validation import test_solver

    for spec in specs:
        resolve(spec, registries.solvers)
    checks = [
        c for c in CHECKS if c.startswith(INVARIANCE_PREFIX) or not options.markdown
    ]
    results = []
    for spec in specs:
        with waiting() as progress:
            result = test_solver(
                spec.name,
                checks=checks,
                time_limit=options.time_limit,
                progress=progress,
                registries=registries,
            )
        results.append(result)
        if not options.json and not options.markdown:
            print(result)
    if options.markdown:
        print(weaknesses_page({one.solver: one.results for one in results}), end="")
        return 0
    if options.json:
        print(json.dumps([row for one in results for row in one.to_dict()["checks"]]))
    for one in results:
        if one.objection:
            say(f"{one.solver} does not conform: it {one.objection}")
    return 0 if all(one.conforms for one in results) else 1


def _named(pattern: str, solvers: Collection[str]) -> list[str]:
    """Return the solvers that match a pattern; if none matches, return the pattern."""
    if "*" not in pattern or pattern in solvers:
        return [pattern]
    matches = [s for s in fnmatch.filter(solvers, pattern) if not s.endswith(":*")]
    return matches or [pattern]
