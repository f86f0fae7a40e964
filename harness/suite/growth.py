"""Settings of suites that all measurements of a result folder share.

A suite that has a result folder may be extended: solvers, cases, tolerances and repeats
may be added. Stored measurements depend on the limits, the accuracy and the steps of
sequences, which must not change.
"""

from __future__ import annotations

from collections.abc import Sequence

from mortarbench.harness.errors import InputError, shown
from mortarbench.harness.suite.suite import SuiteFile

#: settings that must not change, since stored verdicts and times depend on them
FIXED_KEYS = ("time_limit", "memory_limit", "accuracy")


def refuse_changed(old: SuiteFile, new: SuiteFile, where: str) -> None:
    """Refuse a change of a suite that would mix different measurements in a folder.

    Cases and solvers are not compared here; `harness.running.run` compares them with
    the journal.

    where : file of the old suite

    Raises
    ------
    InputError
        If the name, a fixed setting or a sequence has changed.

    """
    refuse_unequal(where, old, "the suite", new, ("name", *FIXED_KEYS))
    for problem in old.problems:
        if problem.sequence is not None and problem not in new.problems:
            raise InputError(
                f"{where} has a sequence of {problem.family} along {problem.sequence} "
                "that the suite lacks; a solver carries data from step to step"
            )


def refuse_unequal(
    one: str, a: SuiteFile, other: str, b: SuiteFile, keys: Sequence[str] = FIXED_KEYS
) -> None:
    """Raise InputError if suites in the files `one` and `other` differ in a key."""
    for key in keys:
        values = getattr(a, key), getattr(b, key)
        if values[0] != values[1]:
            x, y = (f"{v:g}" if isinstance(v, float) else shown(v) for v in values)
            raise InputError(
                f"{key} is {x} in {one}, {y} in {other}; expected equal settings"
            )
