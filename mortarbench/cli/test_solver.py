"""The command `test-solver`: the conformance suite on solvers."""

from __future__ import annotations

import fnmatch
import json
from argparse import Namespace
from collections.abc import Collection

from mortarbench.harness.errors import say
from mortarbench.harness.registry import SolverSpec, check_name, resolve
from mortarbench.registries import Registries


def run(registries: Registries, options: Namespace) -> int:
    """Run every check; 1 if one fails, or if a solver solved nothing at all."""
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
    from mortarbench.validation import test_solver

    for spec in specs:
        resolve(spec, registries.solvers)
    checks = [
        c for c in CHECKS if c.startswith(INVARIANCE_PREFIX) or not options.markdown
    ]
    found = []
    for spec in specs:
        found.append(test_solver(spec.name, checks=checks, registries=registries))
        if not options.json and not options.markdown:
            print(found[-1])
    if options.markdown:
        print(weaknesses_page({one.solver: one.results for one in found}), end="")
        return 0
    if options.json:
        print(json.dumps([row for one in found for row in one.to_dict()["checks"]]))
    for one in found:
        if one.objection:
            say(f"{one.solver} does not conform: it {one.objection}")
    return 0 if all(one.conforms for one in found) else 1


def _named(pattern: str, solvers: Collection[str]) -> list[str]:
    """List the solvers of a registry that a pattern means; a name means itself."""
    if "*" not in pattern or pattern in solvers:
        return [pattern]
    found = [s for s in fnmatch.filter(solvers, pattern) if not s.endswith(":*")]
    return found or [pattern]
