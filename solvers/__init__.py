"""Every solver of the comparison, one line each."""

from harness import Solver
from solvers.adapters.clarabel_ import Clarabel
from solvers.adapters.cvxopt_ import CVXOPT
from solvers.adapters.cvxpy_ import CVXPY
from solvers.adapters.daqp_ import DAQP
from solvers.adapters.highs_ import HiGHS
from solvers.adapters.osqp_ import OSQP
from solvers.adapters.piqp_ import PIQP
from solvers.adapters.proxqp_ import ProxQP
from solvers.adapters.qoco_ import QOCO
from solvers.adapters.qpalm_ import QPALM
from solvers.adapters.qpsolvers_ import QPSolvers
from solvers.adapters.qtqp_ import QTQP
from solvers.adapters.quadprog_ import Quadprog
from solvers.adapters.scs_ import SCS
from solvers.baselines.bvls import BVLS
from solvers.baselines.pdas import PDAS
from solvers.baselines.projected_gradient import ProjectedGradient
from solvers.smalbe.solver import CONDENSED, ESPRESO, PAPER, PERMON, SMALBE

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
