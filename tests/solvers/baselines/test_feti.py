"""FETI for linear problems: published step counts, projectors, declined problems."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_array

from mortarbench.harness import QP, Status, no_rows
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems import PROBLEMS
from mortarbench.solvers.baselines.feti import FETI
from mortarbench.solvers.reference.solve import reference_solution

#: the clamped beam of 2 m × 0.25 m with a point load, in 8 × 1 and 16 × 2 subdomains
BEAM = dict(width=2.0, height=0.25, load="point")
#: the plate of MSolve's tests (Papagiannakis 2011); the left subdomains are softer
PLATE = dict(
    Sx=4, Sy=2, n=5, ny=10, width=3.0, height=1.5, plane="stress", load="nodal",
    supports="eliminated", glue="redundant",
)  # fmt: skip


def plate(**keys):
    family = PROBLEMS["plate"]
    return family.build("dual", family.complete(keys), reference_solution).qp


def equalities(P, q, A, b):
    n = q.size
    return QP(
        P=P, q=q, A=A, b=b, G=no_rows(n), h=np.zeros(0), lb=np.full(n, -np.inf),
        ub=np.full(n, np.inf),
    )  # fmt: skip


@pytest.fixture
def random():
    rng = np.random.default_rng(19910614)
    W = rng.standard_normal((30, 30))
    A = csr_array(rng.standard_normal((4, 30)))
    return equalities(
        W @ W.T / 30, rng.standard_normal(30), A, A @ rng.standard_normal(30)
    )


def test_it_solves_to_the_tolerance(random):
    s = FETI().prepare(random, 1e-9)()

    assert s.status is Status.SOLVED
    assert kkt_residuals(random, s).worst <= 5e-9
    assert s.counts["P_products"] >= s.iterations


def test_as_many_steps_as_distinct_eigenvalues_on_the_kernel_of_the_rows():
    P = np.diag([1.0, 1, 5, 5, 5, 9])
    A = csr_array([[0.0, 0, 0, 0, 0, 1]])
    s = FETI().prepare(equalities(P, np.arange(6.0), A, np.ones(1)), 1e-10)()

    assert s.iterations == 2
    assert s.x[-1] == 1


def test_without_rows_it_is_conjugate_gradients():
    P = np.diag([1.0, 2.0, 7.0])
    s = FETI().prepare(equalities(P, -np.ones(3), no_rows(3), np.zeros(0)), 1e-10)()

    assert s.iterations == 3
    assert s.x == pytest.approx([1, 1 / 2, 1 / 7], rel=1e-9)


@pytest.mark.parametrize(
    ("subdomains", "n", "glue", "kind", "steps"),
    [
        ((8, 1), 4, "redundant", "none", 18),
        ((8, 1), 4, "orthonormal", "none", 16),
        ((8, 1), 8, "orthonormal", "none", 22),
        ((8, 1), 8, "redundant", "lumped", 14),
        ((8, 1), 8, "redundant", "dirichlet", 10),
        ((16, 2), 4, "redundant", "none", 40),
        ((16, 2), 4, "orthonormal", "none", 25),
        ((16, 2), 4, "redundant", "lumped", 16),
        ((16, 2), 4, "orthonormal", "dirichlet", 9),
        ((16, 2), 8, "orthonormal", "dirichlet", 12),
    ],
)
def test_counts_of_a_clamped_beam(subdomains, n, glue, kind, steps):
    """The numbers of steps until ‖P(d − Fλ)‖ is 1e-8 of its initial value differ from
    those of an independent code by at most two.
    """
    Sx, Sy = subdomains
    qp = plate(Sx=Sx, Sy=Sy, n=n, glue=glue, **BEAM)
    s = FETI(preconditioner=kind, scaling="multiplicity").prepare(qp, 1e-8)()

    assert s.status is Status.SOLVED
    assert kkt_residuals(qp, s).worst <= 1e-7
    assert abs(s.counts["steps_to_tol"] - steps) <= 2


@pytest.mark.parametrize(
    ("jump", "identity", "weighted"), [(1e-2, 15, 8), (1e-3, 18, 9), (1e-5, 32, 9)]
)
def test_counts_for_jumping_stiffnesses(jump, identity, weighted):
    """The counts exceed those of MSolve at 1e-5 by at most two steps."""
    qp = plate(pattern="column", jump=jump, **PLATE)
    most = {"identity": identity, "preconditioner": weighted}
    for Q, steps in most.items():
        s = FETI(Q=Q).prepare(qp, 1e-5)()

        assert s.status is Status.SOLVED
        assert s.counts["steps_to_tol"] <= steps + 2


@pytest.mark.parametrize("jump", [1e-3, 1e-5])
def test_weights_without_stiffness_take_more_steps_and_reach_the_tolerance(jump):
    qp = plate(pattern="column", jump=jump, **PLATE)
    runs = [
        FETI(scaling=scaling).prepare(qp, 1e-8)()
        for scaling in ("stiffness", "multiplicity")
    ]

    assert all(s.status is Status.SOLVED for s in runs)
    assert max(kkt_residuals(qp, s).worst for s in runs) <= 5e-8
    assert runs[0].iterations < runs[1].iterations


def test_qps_outside_its_scope_are_declined(random):
    lower = np.where(np.arange(30) == 7, 0.0, -np.inf)
    small = plate(Sx=2, Sy=2, n=2)

    assert FETI().declines(random) is None
    assert "equality rows only" in FETI().declines(replace(random, lb=lower))
    assert "dirichlet" in FETI(preconditioner="dirichlet").declines(random)
    assert "provides" in FETI(Q="preconditioner").declines(random)
    assert FETI(Q="preconditioner").declines(small) is None
    assert "none" in FETI(Q="preconditioner", preconditioner="none").declines(small)


@pytest.mark.parametrize(
    "wrong", [dict(preconditioner="ilu"), dict(scaling="E"), dict(Q="M")], ids=str
)
def test_unknown_options_are_refused(wrong):
    with pytest.raises(ValueError, match=f"{next(iter(wrong))} = .*; expected"):
        FETI(**wrong)


def test_dependent_rows_are_a_failure_with_a_reason(random):
    A = csr_array(np.vstack([random.A.toarray(), random.A.toarray()[:1]]))
    s = FETI().prepare(replace(random, A=A, b=np.append(random.b, random.b[0])), 1e-8)()

    assert s.status is Status.FAILED
    assert "depend" in s.message


def test_an_unbounded_objective_is_not_claimed_solved():
    P = np.diag([1.0, 0.0])
    s = FETI().prepare(equalities(P, np.ones(2), no_rows(2), np.zeros(0)), 1e-8)()

    assert s.status is Status.ITERATION_LIMIT


def test_the_step_limit_is_reported(random):
    s = FETI(max_iter=3).prepare(random, 1e-9)()

    assert (s.status, s.iterations) == (Status.ITERATION_LIMIT, 3)
    assert s.message == "step limit"
