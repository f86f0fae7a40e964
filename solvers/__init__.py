"""Registry of the built-in solvers."""

from mortarbench.harness.plugin import Solver
from mortarbench.harness.registry import Registry, check_solver

#: module of this package and name of a solver, or of its class
_PLACES = {
    "smalbe": "smalbe.solver:SMALBE",
    "smalbe-textbook": "smalbe.textbook:Textbook",
    "smalbe-permon": "smalbe.textbook:PERMON",
    "smalbe-espreso": "smalbe.textbook:ESPRESO",
    "smalbe-paper": "smalbe.textbook:PAPER",
    "pdas": "baselines.pdas:PDAS",
    "ipm-amg": "baselines.ipm_amg:IPMAMG",
    "projected-gradient": "baselines.projected_gradient:ProjectedGradient",
    "nsgs": "baselines.gauss_seidel:GaussSeidel",
    "osqp": "adapters.osqp_:OSQP",
    "osqp-polish": "adapters.osqp_:POLISH",
    "clarabel": "adapters.clarabel_:Clarabel",
    "proxqp": "adapters.proxqp_:ProxQP",
    "proxqp-dense": "adapters.proxqp_:DENSE",
    "proxqp-sparse": "adapters.proxqp_:SPARSE",
    "piqp": "adapters.piqp_:PIQP",
    "piqp-dense": "adapters.piqp_:DENSE",
    "piqp-sparse": "adapters.piqp_:SPARSE",
    "highs": "adapters.highs_:HiGHS",
    "highs-hipo": "adapters.highs_:HIPO",
    "scs": "adapters.scs_:SCS",
    "scs-qdldl": "adapters.scs_:QDLDL",
    "daqp": "adapters.daqp_:DAQP",
    "qpalm": "adapters.qpalm_:QPALM",
    "qoco": "adapters.qoco_:QOCO",
    "qtqp": "adapters.qtqp_:QTQP",
    "qpsolvers:*": "adapters.qpsolvers_:QPSolvers",
    "cvxpy:*": "adapters.cvxpy_:CVXPY",
}
SOLVERS: Registry[Solver] = Registry(
    {name: f"mortarbench.solvers.{place}" for name, place in _PLACES.items()},
    check_solver,
    "mortarbench.solvers",
)
