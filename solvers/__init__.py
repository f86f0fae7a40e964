"""Registry of the built-in solvers."""

from mortarbench.harness.plugin import Solver
from mortarbench.harness.registry import Registry, entry

SOLVERS: Registry[Solver] = Registry(
    {
        "smalbe": entry("mortarbench.solvers.smalbe.solver", "SMALBE"),
        "smalbe-condensed": entry("mortarbench.solvers.smalbe.solver", "CONDENSED"),
        "smalbe-direct": entry("mortarbench.solvers.smalbe.direct", "Direct"),
        "smalbe-permon": entry("mortarbench.solvers.smalbe.solver", "PERMON"),
        "smalbe-espreso": entry("mortarbench.solvers.smalbe.solver", "ESPRESO"),
        "smalbe-paper": entry("mortarbench.solvers.smalbe.solver", "PAPER"),
        "pdas": entry("mortarbench.solvers.baselines.pdas", "PDAS"),
        "ipm-amg": entry("mortarbench.solvers.baselines.ipm_amg", "IPMAMG"),
        "projected-gradient": entry(
            "mortarbench.solvers.baselines.projected_gradient", "ProjectedGradient"
        ),
        "nsgs": entry("mortarbench.solvers.baselines.gauss_seidel", "GaussSeidel"),
        "osqp": entry("mortarbench.solvers.adapters.osqp_", "OSQP"),
        "osqp-polish": entry(
            "mortarbench.solvers.adapters.osqp_", "OSQP", polishing=True
        ),
        "clarabel": entry("mortarbench.solvers.adapters.clarabel_", "Clarabel"),
        "proxqp": entry("mortarbench.solvers.adapters.proxqp_", "ProxQP"),
        "proxqp-dense": entry(
            "mortarbench.solvers.adapters.proxqp_", "ProxQP", backend="dense"
        ),
        "proxqp-sparse": entry(
            "mortarbench.solvers.adapters.proxqp_", "ProxQP", backend="sparse"
        ),
        "piqp": entry("mortarbench.solvers.adapters.piqp_", "PIQP"),
        "piqp-dense": entry(
            "mortarbench.solvers.adapters.piqp_", "PIQP", backend="dense"
        ),
        "piqp-sparse": entry(
            "mortarbench.solvers.adapters.piqp_", "PIQP", backend="sparse"
        ),
        "highs": entry("mortarbench.solvers.adapters.highs_", "HiGHS"),
        "highs-hipo": entry(
            "mortarbench.solvers.adapters.highs_", "HiGHS", method="hipo"
        ),
        "scs": entry("mortarbench.solvers.adapters.scs_", "SCS"),
        "scs-qdldl": entry(
            "mortarbench.solvers.adapters.scs_", "SCS", linear_solver="qdldl"
        ),
        "daqp": entry("mortarbench.solvers.adapters.daqp_", "DAQP"),
        "qpalm": entry("mortarbench.solvers.adapters.qpalm_", "QPALM"),
        "qoco": entry("mortarbench.solvers.adapters.qoco_", "QOCO"),
        "qtqp": entry("mortarbench.solvers.adapters.qtqp_", "QTQP"),
        "qpsolvers:*": entry("mortarbench.solvers.adapters.qpsolvers_", "QPSolvers"),
        "cvxpy:*": entry("mortarbench.solvers.adapters.cvxpy_", "CVXPY"),
    }
)
