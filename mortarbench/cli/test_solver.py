"""The command `test-solver`: run the conformance suite on solvers."""

from __future__ import annotations

import fnmatch
from collections.abc import Collection, Sequence
from json import dumps
from typing import Annotated, Any

import mortarbench as mb
from mortarbench.harness.errors import InputError, say
from mortarbench.harness.registry import check_name
from mortarbench.progress import waiting
from mortarbench.registries import Registries


def test_solver(
    registries: Registries,
    solvers: Annotated[Sequence[str], "NAME"],
    *,
    markdown: bool = False,  # noqa: PT028  # not a test
    json: bool = False,  # noqa: PT028
    **arguments: Any,
) -> int:
    """Run the conformance suite on solvers: QPs with known solutions.

    Exit code 1: a check fails, or a solver solves no QP.

    solvers : a solver, or a pattern such as 'p*'
    markdown : print only the failed checks and the weaknesses, as a Markdown list
    json : print JSON
    """
    if markdown and json:
        raise InputError("--json: not allowed with --markdown; expected one of them")
    names = [n for pattern in solvers for n in _named(pattern, registries.solvers)]
    for name in names:
        check_name(name, registries.solvers)
    results = []
    for name in names:
        with waiting() as progress:
            result = mb.test_solver(
                name,
                progress=progress,
                registries=registries,
                **arguments,
            )
        results.append(result)
        if not json:
            print(result.to_markdown() if markdown else result)
    if json:
        print(dumps([row for one in results for row in one.to_dict()["checks"]]))
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
