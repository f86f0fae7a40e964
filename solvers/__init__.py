"""Every solver of the comparison, one line each."""

from harness import Solver
from solvers.bvls_ import BVLS
from solvers.clarabel_ import Clarabel
from solvers.cvxopt_ import CVXOPT
from solvers.cvxpy_ import CVXPY
from solvers.daqp_ import DAQP
from solvers.highs_ import HiGHS
from solvers.osqp_ import OSQP
from solvers.pdas import PDAS
from solvers.piqp_ import PIQP
from solvers.projected_gradient import ProjectedGradient
from solvers.proxqp_ import ProxQP
from solvers.qoco_ import QOCO
from solvers.qpalm_ import QPALM
from solvers.qpsolvers_ import QPSolvers
from solvers.qtqp_ import QTQP
from solvers.quadprog_ import Quadprog
from solvers.scs_ import SCS
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
    "osqp-polish": OSQP(polishing=True),
    "clarabel": Clarabel(),
    "proxqp": ProxQP(),
    "proxqp-dense": ProxQP(backend="dense"),
    "proxqp-sparse": ProxQP(backend="sparse"),
    "piqp": PIQP(),
    "piqp-dense": PIQP(backend="dense"),
    "piqp-sparse": PIQP(backend="sparse"),
    "highs": HiGHS(),
    "highs-hipo": HiGHS(method="hipo"),
    "scs": SCS(),
    "scs-qdldl": SCS(linear_solver="qdldl"),
    "daqp": DAQP(),
    "qpalm": QPALM(),
    "qoco": QOCO(),
    "qtqp": QTQP(),
    "quadprog": Quadprog(),
    "cvxopt": CVXOPT(),
    "qpsolvers:*": QPSolvers(),
    "cvxpy:*": CVXPY(),
}
