"""Cases by name, with their reference solutions."""

from mortarbench.harness.names import parse
from mortarbench.problems import PROBLEMS
from mortarbench.solvers.reference.solve import reference_solution


def built(name):
    return parse(name, PROBLEMS).build(reference_solution)


def solved(name):
    """Return a case, its solution and its quantities."""
    case = built(name)
    s = reference_solution(case.qp)
    return case, s, case.quantities(s)
