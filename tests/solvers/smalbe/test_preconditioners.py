"""Preconditioners on faces: exact cases, restriction to the face, counters."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy.sparse import csr_array

from mortarbench.harness import QP, Status, Structure, no_rows
from mortarbench.harness.files.qpfile import load_qp, save_qp
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems import PROBLEMS
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe.driver import outer_loop
from mortarbench.solvers.smalbe.projected import by_lanczos, projected_problem
from mortarbench.solvers.smalbe.solver import SMALBE


def chain(n):
    """Return the stiffness of n springs in series, fixed at the left end."""
    K = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    K[-1, -1] = 1
    return K


@pytest.fixture
def gap():
    """Return the dual of one body; rows select every third node, and F = BK⁻¹Bᵀ."""
    K, B = chain(30), np.eye(30)[::3]
    structure = Structure(
        K=csr_array(K), B=csr_array(B), fixed=np.zeros(0, dtype=np.int64)
    )
    n = len(B)
    return QP(
        P=B @ np.linalg.solve(K, B.T), q=np.linspace(-1, 2, n), A=no_rows(n),
        b=np.zeros(0), G=no_rows(n), h=np.zeros(0), lb=np.zeros(n),
        ub=np.full(n, np.inf), structure=structure,
    )  # fmt: skip


@pytest.fixture
def in_face():
    """Return the preconditioner on a face and the norm of the projected problem."""

    def prepared(qp, kind, free):
        problem = projected_problem(qp, partial(by_lanczos, steps=8))
        solver = outer_loop(problem, qp, SMALBE(preconditioner=kind)).solver
        return lambda v: solver.precondition(free, v, 1.0), problem.spectrum.norm

    return prepared


@pytest.fixture
def whole(in_face):
    """Return the preconditioner on the face of all components as a matrix."""

    def matrix(qp, kind):
        n = qp.q.size
        apply, norm = in_face(qp, kind, np.full(n, True))
        return np.column_stack([apply(v) for v in np.eye(n)]) / norm

    return matrix


def test_dirichlet_inverts_the_dual_of_one_body(whole, gap):
    """If B selects components, then B_D S B_Dᵀ = (BK⁻¹Bᵀ)⁻¹."""
    assert whole(gap, "dirichlet") @ gap.P == pytest.approx(np.eye(10), abs=1e-7)


def test_lumped_is_the_stiffness_at_the_interface(whole, gap):
    K_bb = gap.structure.K.toarray()[::3, ::3]

    assert whole(gap, "lumped") == pytest.approx(K_bb, abs=1e-8)


def test_diagonal_divides_by_the_diagonal(whole, gap):
    assert whole(gap, "diagonal") @ np.diag(gap.P) == pytest.approx(np.ones(10))


@pytest.mark.parametrize("kind", ["dirichlet", "lumped", "diagonal"])
def test_fixed_components_are_excluded(whole, kind):
    """A chain with a fixed interior node consists of two chains."""
    K, B = chain(9), np.eye(9)[[1, 3, 6, 8]]
    free = np.arange(9) != 4
    F = B[:, free] @ np.linalg.solve(K[np.ix_(free, free)], B[:, free].T)
    structure = Structure(K=csr_array(K), B=csr_array(B), fixed=np.array([4]))
    qp = QP(
        P=F, q=-np.ones(4), A=no_rows(4), b=np.zeros(0), G=no_rows(4), h=np.zeros(0),
        lb=np.zeros(4), ub=np.full(4, np.inf), structure=structure,
    )  # fmt: skip
    M = whole(qp, kind)

    assert abs(M[:2, 2:]).max() < 1e-12
    assert np.linalg.eigvalsh(M).min() > 0
    if kind == "dirichlet":
        assert pytest.approx(np.eye(4), abs=1e-7) == M @ F


def test_a_masked_preconditioner_stays_in_the_face(in_face, gap):
    free = np.arange(10) % 2 == 0
    z = in_face(gap, "dirichlet", free)[0](np.ones(10))

    assert (z[~free] == 0).all()
    assert (z[free] != 0).all()


@pytest.mark.parametrize("kind", ["dirichlet", "lumped"])
def test_structural_preconditioners_are_declined_without_structure(gap, kind):
    solver = SMALBE(preconditioner=kind)

    assert "structure" in solver.declines(replace(gap, structure=None))
    assert solver.declines(gap) is None


@pytest.mark.parametrize("form", ["dual", "dual-bounds"])
@pytest.mark.parametrize("kind", ["dirichlet", "lumped", "diagonal"])
def test_preconditioned_solves_converge_and_applications_are_counted(form, kind):
    family = PROBLEMS["beam-ring"]
    configured = family.with_keys(Nr=4, Nh=3)
    qp = configured.build(form, reference_solution).qp
    s = SMALBE(preconditioner=kind).prepare(qp, 1e-8)()

    assert s.status is Status.SOLVED
    assert kkt_residuals(qp, s).worst <= 1e-7
    assert s.counts["preconditioner_applies"] > 0


def test_structure_survives_the_file(gap, tmp_path):
    save_qp(tmp_path / "qp.npz", gap, {}, serialised=True)
    loaded, _ = load_qp(tmp_path / "qp.npz", operators={})

    assert (loaded.structure.K != gap.structure.K).nnz == 0
    assert (loaded.structure.B != gap.structure.B).nnz == 0
    assert (loaded.structure.fixed == gap.structure.fixed).all()


@pytest.mark.parametrize("form", ["dual", "dual-bounds"])
def test_the_matrix_of_a_dual_agrees_with_its_structure(form):
    """P = BK⁺Bᵀ on self-equilibrated λ, for any generalised inverse."""
    family = PROBLEMS["beam-ring"]
    configured = family.with_keys(Nr=4, Nh=3)
    qp = configured.build(form, reference_solution).qp
    K, B = qp.structure.K.toarray(), qp.structure.B.toarray()
    free = np.setdiff1d(np.arange(len(K)), qp.structure.fixed)
    F = (
        B[:, free]
        @ np.linalg.pinv(K[np.ix_(free, free)], hermitian=True)
        @ B[:, free].T
    )
    A = qp.A.toarray() if hasattr(qp.A, "toarray") else qp.A
    rows = np.linalg.qr(A.T)[0] if len(A) else np.zeros((qp.q.size, 0))
    project = np.eye(qp.q.size) - rows @ rows.T

    difference = project @ (F - qp.P) @ project
    assert abs(difference).max() <= 1e-9 * abs(qp.P).max()
