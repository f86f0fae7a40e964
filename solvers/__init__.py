"""Every solver of the comparison, one line each."""

from harness.plugin import Solver
from harness.registry import Registry, entry

SOLVERS: Registry[Solver] = Registry(
    {
        "smalbe": entry("solvers.smalbe.solver", "SMALBE"),
        "smalbe-condensed": entry("solvers.smalbe.solver", "CONDENSED"),
        "smalbe-direct": entry("solvers.smalbe.direct", "Direct"),
        "smalbe-permon": entry("solvers.smalbe.solver", "PERMON"),
        "smalbe-espreso": entry("solvers.smalbe.solver", "ESPRESO"),
        "smalbe-paper": entry("solvers.smalbe.solver", "PAPER"),
        "pdas": entry("solvers.baselines.pdas", "PDAS"),
        "feti": entry("solvers.baselines.feti", "FETI"),
        "projected-gradient": entry(
            "solvers.baselines.projected_gradient", "ProjectedGradient"
        ),
        "bvls": entry("solvers.baselines.bvls", "BVLS"),
        "osqp": entry("solvers.adapters.osqp_", "OSQP"),
        "osqp-polish": entry("solvers.adapters.osqp_", "OSQP", polishing=True),
        "clarabel": entry("solvers.adapters.clarabel_", "Clarabel"),
        "proxqp": entry("solvers.adapters.proxqp_", "ProxQP"),
        "proxqp-dense": entry("solvers.adapters.proxqp_", "ProxQP", backend="dense"),
        "proxqp-sparse": entry("solvers.adapters.proxqp_", "ProxQP", backend="sparse"),
        "piqp": entry("solvers.adapters.piqp_", "PIQP"),
        "piqp-dense": entry("solvers.adapters.piqp_", "PIQP", backend="dense"),
        "piqp-sparse": entry("solvers.adapters.piqp_", "PIQP", backend="sparse"),
        "highs": entry("solvers.adapters.highs_", "HiGHS"),
        "highs-hipo": entry("solvers.adapters.highs_", "HiGHS", method="hipo"),
        "scs": entry("solvers.adapters.scs_", "SCS"),
        "scs-qdldl": entry("solvers.adapters.scs_", "SCS", linear_solver="qdldl"),
        "daqp": entry("solvers.adapters.daqp_", "DAQP"),
        "qpalm": entry("solvers.adapters.qpalm_", "QPALM"),
        "qoco": entry("solvers.adapters.qoco_", "QOCO"),
        "qtqp": entry("solvers.adapters.qtqp_", "QTQP"),
        "quadprog": entry("solvers.adapters.quadprog_", "Quadprog"),
        "cvxopt": entry("solvers.adapters.cvxopt_", "CVXOPT"),
        "qpsolvers:*": entry("solvers.adapters.qpsolvers_", "QPSolvers"),
        "cvxpy:*": entry("solvers.adapters.cvxpy_", "CVXPY"),
    }
)
