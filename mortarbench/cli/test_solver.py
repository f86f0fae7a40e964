"""The command `test-solver`: run the conformance suite on solvers."""

from __future__ import annotations

from collections.abc import Sequence
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

    solvers : names of solvers
    markdown : print only the failed checks and the weaknesses, as a Markdown list
    json : print JSON
    """
    if markdown and json:
        raise InputError("--json: not allowed with --markdown; expected one of them")
    for name in solvers:
        check_name(name, registries.solvers)
    results = []
    for name in solvers:
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
