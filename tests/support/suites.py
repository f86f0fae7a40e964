"""Suites without a file, for tests of runs."""

from mortarbench.harness.registry import SolverSpec
from mortarbench.harness.suite.parameter_grid import Cases
from mortarbench.harness.suite.suite import Suite, SuiteFile


def suite_of(*solvers, cases=(), sequences=(), **settings):
    """Return a suite of solvers, by name or as `SolverSpec`, on cases."""
    settings = {"name": "test", "repeats": 1, **settings}
    specs = (SolverSpec(name=s, label=s) if isinstance(s, str) else s for s in solvers)
    return Suite(
        file=SuiteFile(**settings), solvers=tuple(specs),
        cases=Cases(cold=tuple(cases), sequences=sequences),
    )  # fmt: skip
