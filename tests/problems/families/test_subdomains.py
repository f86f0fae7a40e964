"""Families in subdomains: the displacement equals that of undivided bodies."""

from functools import cache

import numpy as np
import pytest

from mortarbench.harness import InputError, Status
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.harness.verify.verdicts import certified
from mortarbench.problems.contact import bodies
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.reference.solve import reference_solution
from tests.support.cases import built
from tests.support.press import described

pytestmark = pytest.mark.together

TOL = 1e-8
GLUES = ("orthonormal", "redundant")
COULOMB = "friction=coulomb/mu=0.3"
CASES = [
    ("beam-ring/Nr=2/Nh=2/steps=1", "feti=2"),
    ("beam-ring/Nr=3/Nh=2/steps=2/contact=mortar", "feti=4"),
    ("contact-patch/lower=4/upper=6", "feti=2"),
    (f"contact-patch/lower=4/upper=6/{COULOMB}", "feti=2"),
    ("hertz-plane/n=2", "feti=5"),
    ("greco/n=6", "feti=3"),
    ("cube-wall/n=4", "feti=2"),
    ("cube-wall/n=3", "feti=2"),
    ("hertz-sphere/n=1", "feti=3"),
    ("contact-patch/lower=4/upper=3/dim=3/distort=0.2", "feti=2"),
    ("contact-patch/lower=4/upper=3/friction=tresca/bound=1e5/dim=3", "feti=2"),
    ("beam-ring/Nr=1/Nh=1/steps=2/depth=2", "feti=2"),
    ("greco/n=3/dim=3", "feti=2"),
    ("obstacle/n=8", "feti=3"),
    ("obstacle/dim=1/n=12", "feti=4"),
]


@cache
def in_one_piece(name):
    whole = built(f"{name}/dual")
    u = whole.mechanics.to_primal(reference_solution(whole.qp)).x
    return u, whole.mechanics.primal.P


def check(name, cut, glue):
    u, K = in_one_piece(name)
    case = built(f"{name}/{cut}/glue={glue}/dual")
    s = SOLVERS["smalbe"].prepare(case.qp, TOL)()
    error = case.mechanics.to_primal(s).x - u
    bound = certified(case, s)[0]["energy_bound"]
    relative = np.sqrt(max(error @ (K @ error), 0.0) / (u @ (K @ u)))

    assert s.status is Status.SOLVED
    assert kkt_residuals(case.qp, s).worst <= 10 * TOL
    assert abs(error).max() <= 10 * TOL * abs(u).max()
    assert relative <= 10 * TOL
    assert relative <= bound * (1 + 1e-6) + 1e-10
    assert bound <= 1e-5


@pytest.mark.parametrize(
    ("name", "cut", "glue"),
    [
        pytest.param(*case, glue, marks=[pytest.mark.slow] * (i % 2 != j))
        for i, case in enumerate(CASES)
        for j, glue in enumerate(GLUES)
    ],
)
def test_the_displacement_is_that_of_the_undecomposed_bodies(name, cut, glue):
    check(name, cut, glue)


def test_the_first_step_factorises_no_undecomposed_body(monkeypatch):
    def refused(*_: object) -> None:
        raise AssertionError("a factor of the whole")

    monkeypatch.setattr(bodies, "factorise_clamped", refused)
    monkeypatch.setattr(bodies, "factorise_floating", refused)
    case = built("beam-ring/Nr=2/Nh=3/steps=2/step=1/feti=2/dual")
    s = SOLVERS["smalbe"].prepare(case.qp, TOL)()
    assert certified(case, s)[0]["energy_bound"] <= 1e-5


@pytest.fixture
def press(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    described(tmp_path)
    return "bodies:press.toml"


@pytest.mark.parametrize(
    "glue",
    [pytest.param("orthonormal", marks=pytest.mark.slow), "redundant"],
)
def test_bodies_of_any_mesh_can_be_decomposed(press, glue):
    check(press, "parts=8", glue)


def test_bodies_with_friction_can_be_decomposed(press):
    check(f"{press}/friction=tresca/bound=1e7", "parts=8", "orthonormal")


@pytest.mark.parametrize("name", ["obstacle/n=8", "obstacle/dim=1/n=9"])
def test_the_dual_of_an_obstacle_problem_has_supports_as_rows(name):
    """The solution equals that of the form in which supports are eliminated."""
    u, _ = in_one_piece(name)
    eliminated = built(f"{name}/dual-bounds")
    exact = eliminated.mechanics.to_primal(reference_solution(eliminated.qp)).x

    assert u == pytest.approx(exact, abs=1e-12)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("obstacle/feti=4/primal", "feti with form primal is not built"),
        ("obstacle/feti=4/dual-bounds", "feti with form dual-bounds is not built"),
        ("hertz-plane/feti=4/primal", "feti with form primal is not built"),
        ("bodies:press.toml/parts=8/primal", "parts with form primal is not built"),
        (
            "bodies:press.toml/parts=2/dual",
            r"parts=2 for 3 bodies .* expected 3 to 1044",
        ),
    ],
)
def test_unsupported_combinations_are_refused_by_name(press, name, message):
    with pytest.raises(InputError, match=message):
        built(name)


@pytest.mark.parametrize(("n", "most"), [(4, 45), (8, 60)])
def test_subdomains_of_graded_meshes_are_compact(n, most):
    """With blocks of 8 × 8 cells, 95 (n = 4) and 359 (n = 8) products would be
    required."""
    case = built(f"hertz-plane/n={n}/feti=8/dual")
    s = SOLVERS["smalbe"].prepare(case.qp, 1e-6)()

    assert s.status is Status.SOLVED
    assert s.counts["P_products"] <= most


@pytest.mark.parametrize(
    "name",
    [
        "obstacle/n=8/shape=hemisphere/feti=4/glue=redundant/dual",
        "beam-ring/Nr=4/Nh=2/steps=1/feti=2/glue=redundant/dual",
    ],
)
def test_multipliers_of_redundant_rows_do_not_drift(name):
    """The component of λ in ker Bᵀ remains below 1e-7 ‖λ‖."""
    qp = built(name).qp
    operator = qp.P.build()
    rows = operator.B[: operator.equalities]
    size, modes = np.linalg.eigh((rows @ rows.T).toarray())
    unfelt = modes[:, size < 1e-10 * size[-1]]
    s = SOLVERS["smalbe"].prepare(qp, TOL)()

    assert unfelt.shape[1] > 0
    assert s.status is Status.SOLVED
    drift = unfelt.T @ s.x[: operator.equalities]
    assert np.linalg.norm(drift) <= 1e-7 * np.linalg.norm(s.x)
