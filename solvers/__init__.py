"""Every solver of the comparison, one line each."""

from harness import Solver
from solvers.clarabel_ import Clarabel
from solvers.cvxpy_ import CVXPY
from solvers.osqp_ import OSQP
from solvers.proxqp_ import ProxQP
from solvers.qpsolvers_ import QPSolvers
from solvers.smalbe import CONDENSED, ESPRESO, PAPER, PERMON, SMALBE

SOLVERS: dict[str, Solver] = {
    "smalbe": SMALBE(),
    "smalbe-condensed": CONDENSED,
    "smalbe-permon": PERMON,
    "smalbe-espreso": ESPRESO,
    "smalbe-paper": PAPER,
    "osqp": OSQP(),
    "clarabel": Clarabel(),
    "proxqp": ProxQP(),
    "qpsolvers:*": QPSolvers(),
    "cvxpy:*": CVXPY(),
}
