"""Every solver of the comparison, one line each."""

from harness import Solver
from solvers.bvls_ import BVLS
from solvers.clarabel_ import Clarabel
from solvers.cvxpy_ import CVXPY
from solvers.osqp_ import OSQP
from solvers.pdas import PDAS
from solvers.projected_gradient import ProjectedGradient
from solvers.proxqp_ import ProxQP
from solvers.qpsolvers_ import QPSolvers
from solvers.smalbe import CONDENSED, ESPRESO, PAPER, PERMON, SMALBE

SOLVERS: dict[str, Solver] = {
    "smalbe": SMALBE(),
    "smalbe-condensed": CONDENSED,
    "smalbe-permon": PERMON,
    "smalbe-espreso": ESPRESO,
    "smalbe-paper": PAPER,
    "pdas": PDAS(),
    "projected-gradient": ProjectedGradient(),
    "bvls": BVLS(),
    "osqp": OSQP(),
    "clarabel": Clarabel(),
    "proxqp": ProxQP(),
    "qpsolvers:*": QPSolvers(),
    "cvxpy:*": CVXPY(),
}
