"""Suites of the checkout measured for a page, not for a result folder of their own."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path

from harness.environment.environment import capture, digest
from harness.registry import resolve
from harness.running.progress import shown_on
from harness.running.run import run
from harness.suite.overrides import with_overrides
from harness.suite.suite import load_suite
from mortarbench.cli.registries import Registries


def measured(
    registries: Registries,
    name: str,
    out: Path,
    *,
    solvers: Sequence[str] = (),
    cases: Sequence[str] = (),
    repeats: int | None = None,
) -> None:
    """Measure a suite into `out`, anew; narrowed as `with_overrides` does.

    Raises
    ------
    InputError
        When there is no such suite, or `out` is in use or not a result folder.

    """
    suite = with_overrides(
        load_suite(
            registries.suite_path(name), registries.families, registries.solvers
        ),
        registries.families,
        registries.solvers,
        solvers=solvers,
        cases=cases,
        repeats=repeats,
    )
    environment = capture()
    with shown_on(sys.stderr) as progress:
        run(
            suite,
            out=out,
            commands=registries.commands(suite.solvers, ()),
            resolve=lambda spec: resolve(spec, registries.solvers),
            environment=environment,
            digest=digest(environment),
            progress=progress,
            fresh=True,
        )
