"""Plug-in with an exact solver, and solvers with false claims.

Two of the solvers with false claims call libraries with their default options.

The plug-in contains two families without mechanics: a membrane, and
min ½(x + 1)², x ≤ 0.
"""

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from scipy.sparse import eye_array, tril

from mortarbench.harness import QP, Case, Family, Solution, Status, no_rows
from mortarbench.harness.conformance.manufactured import membrane
from mortarbench.solvers.common.conversion import csc
from mortarbench.solvers.reference.solve import reference_solution


@dataclass(frozen=True)
class Membrane(Family):
    forms: ClassVar = ("qp",)

    k: int = 12

    def build(self, form, reference):
        return Case(qp=membrane(self.k), recover=lambda s: s.x, quantities=lambda s: {})


@dataclass(frozen=True)
class Half(Family):
    forms: ClassVar = ("qp",)

    def build(self, form, reference):
        qp = QP(
            P=np.eye(1), q=np.ones(1), A=no_rows(1), b=np.zeros(0),
            G=np.eye(1), h=np.zeros(1), lb=np.full(1, -np.inf), ub=np.full(1, np.inf),
        )  # fmt: skip
        return Case(qp=qp, recover=lambda s: s.x, quantities=lambda s: {})


class Any:
    """Solver that accepts every QP."""

    def declines(self, qp):
        return None


@dataclass(frozen=True)
class Exact(Any):
    def prepare(self, qp, tol):
        return lambda: reference_solution(qp)


@dataclass(frozen=True)
class Stale(Any):
    """Solver that returns the answer to the previous QP of the same size."""

    def prepare(self, qp, tol):
        def solve():
            answer, before = reference_solution(qp), MEMORY.get(qp.q.size)
            MEMORY[qp.q.size] = answer
            return answer if before is None else before

        return solve


@dataclass(frozen=True)
class Pulls(Any):
    """Solver that returns a multiplier of the wrong sign on an inactive constraint."""

    def prepare(self, qp, tol):
        def solve():
            s = reference_solution(qp)
            z, z_box = s.z.copy(), s.z_box.copy()
            if z.size:
                z[np.argmax(qp.h - qp.G @ s.x)] = -np.abs(z).max()
            else:
                z_box[np.argmax(s.x - qp.lb)] = np.abs(z_box).max()
            return replace(s, z=z, z_box=z_box)

        return solve


@dataclass(frozen=True)
class AtTheRow(Any):
    """Solver that returns x = 0 and balances the gradient by a multiplier < 0."""

    def prepare(self, qp, tol):
        none = dict(y=np.zeros(0), z_box=np.zeros(1))
        return lambda: Solution(
            status=Status.SOLVED, x=np.zeros(1), z=-np.ones(1), **none
        )


@dataclass(frozen=True)
class Denies(Any):
    """Solver that claims that the QP is infeasible."""

    def prepare(self, qp, tol):
        return lambda: Solution.without_point(qp, Status.INFEASIBLE)


@dataclass(frozen=True)
class UncheckedProxQP(Any):
    """ProxQP with its default options, which do not test the duality gap."""

    def prepare(self, qp, tol):
        from proxsuite import proxqp

        n = qp.q.size
        solver = proxqp.sparse.QP(n, 0, n)
        solver.init(csc(qp.P), qp.q, csc(qp.A), qp.b, csc(eye_array(n)), qp.lb, qp.ub)
        solver.settings.eps_abs, solver.settings.eps_rel = tol, 0.0
        solver.settings.check_duality_gap = False

        def solve():
            solver.solve()
            r = solver.results
            claims = r.info.status == proxqp.QPSolverOutput.PROXQP_SOLVED
            return Solution(
                status=Status.SOLVED if claims else Status.FAILED,
                x=np.array(r.x), y=np.zeros(0), z=np.zeros(0), z_box=np.array(r.z),
                message=str(r.info.status),
            )  # fmt: skip

        return solve


@dataclass(frozen=True)
class BareHiGHS(Any):
    """HiGHS with its default options, for QPs with bounds only."""

    def prepare(self, qp, tol):
        import highspy

        solver, n = highspy.Highs(), qp.q.size
        solver.setOptionValue("output_flag", False)
        model, P = highspy.HighsModel(), csc(tril(csc(qp.P)))
        lp, hessian = model.lp_, model.hessian_
        lp.num_col_, lp.num_row_ = n, 0
        lp.col_cost_, lp.col_lower_, lp.col_upper_ = qp.q, qp.lb, qp.ub
        lp.a_matrix_.format_ = highspy.MatrixFormat.kColwise
        lp.a_matrix_.num_col_, lp.a_matrix_.num_row_ = n, 0
        lp.a_matrix_.start_ = np.zeros(n + 1, dtype=np.int32)
        hessian.dim_, hessian.format_ = n, highspy.HessianFormat.kTriangular
        hessian.start_, hessian.index_ = P.indptr, P.indices
        hessian.value_ = P.data
        solver.passModel(model)

        def solve():
            solver.run()
            found, name = solver.getSolution(), solver.getModelStatus().name
            return Solution(
                status=Status.SOLVED if name == "kOptimal" else Status.FAILED,
                x=np.array(found.col_value), y=np.zeros(0), z=np.zeros(0),
                z_box=-np.array(found.col_dual), message=name,
            )  # fmt: skip

        return solve


MEMORY = {}  #: last answer of `Stale` for each size
SOLVERS = {
    "exact": Exact(),
    "stale": Stale(),
    "pulls": Pulls(),
    "denies": Denies(),
    "at-the-row": AtTheRow(),
    "proxqp-unchecked": UncheckedProxQP(),
    "highs-bare": BareHiGHS(),
}
PROBLEMS = {"membrane": Membrane(), "half": Half()}
