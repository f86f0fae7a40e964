"""Plug-ins and data of the tests, and their paths."""

from pathlib import Path

SUPPORT = Path(__file__).parent
ROOT = SUPPORT.parents[1]  #: root of the checkout

ACCIDENTS = SUPPORT / "accidents.py"
ADVERSARIES = SUPPORT / "adversaries.py"
FALSE_CLAIMS = SUPPORT / "false_claims.py"
FAULTY_SOLVERS = SUPPORT / "faulty_solvers.py"
HISTORIES = SUPPORT / "histories.py"
TOY_PROBLEM = SUPPORT / "toy_problem.py"

#: function of which tests of runs replace the result, because a report takes seconds
WRITE_REPORT = "mortarbench.reports.folder.write_report"


def no_report(folder, formats, factor):
    """Write nothing, in place of `WRITE_REPORT`."""
    return [], []
