"""Conic solvers on discs and cones: planted solutions, degenerate sets, sequences."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_array, eye_array

import mortarbench as mb
from mortarbench.harness import QP, Cones, Discs, Solution, Status
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.common.conversion import to_cone
from tests.support.bounded import bounded

WILDCARDS = ("cvxpy:CLARABEL", "cvxpy:SCS", "cvxpy:QOCO")
NATIVE = ("clarabel", "scs", "qoco")


def solver_of(name):
    library, colon, backend = name.partition(":")
    return replace(SOLVERS[f"{library}:*"], backend=backend) if colon else SOLVERS[name]


def unit(rng, d):
    direction = rng.standard_normal(d)
    return direction / np.linalg.norm(direction)


def conic_qp(seed):
    """Draw a QP with rows, bounds, discs and cones, and its strictly complementary
    solution.

    Discs are active (z = c·x), inactive, or points (radius 0, any z). In a cone, x is
    on the boundary, inside, or at the apex, and one cone has slope 0.
    """
    rng = np.random.default_rng(seed)
    k, d, m, p = 6, int(rng.integers(2, 4)), 2, 3
    n = k * d + k * 3 + 6
    order = rng.permutation(n)
    discs = order[: k * d].reshape(k, d)
    cones = order[k * d : k * d + 3 * k].reshape(k, 3)
    bounded = order[k * d + 3 * k :][:4]
    x, z = rng.standard_normal(n), np.zeros(n)
    radius = rng.uniform(0.2, 2.0, k)
    radius[-1] = 0.0
    for i, block in enumerate(discs):
        at = unit(rng, d)
        is_active = i % 2 == 0
        x[block] = radius[i] * at * (1.0 if is_active else 0.6)
        z[block] = at * rng.uniform(0.5, 2.0) * (is_active or not radius[i])
    slope = rng.uniform(0.2, 2.0, k)
    slope[-1] = 0.0
    for i, (normal, *tangents) in enumerate(cones):
        at, size = unit(rng, 2), rng.uniform(0.5, 2.0)
        if i == k - 1:  # x_T = 0, x_N > 0: z_N = 0, any z_T
            x[normal], x[tangents], z[tangents] = size, 0.0, at
        elif i % 3 == 0:  # on the boundary
            x[normal], x[tangents] = size, slope[i] * size * at
            z[normal], z[tangents] = -slope[i], at
        elif i % 3 == 1:  # inside
            x[normal], x[tangents] = size, 0.5 * slope[i] * size * at
        else:  # apex, z inside the polar cone
            x[[normal, *tangents]] = 0.0
            z[normal], z[tangents] = -size, 0.5 * size / slope[i] * at
    lb, ub = np.full(n, -np.inf), np.full(n, np.inf)
    lb[bounded[0]], z[bounded[0]] = x[bounded[0]], -1.0
    ub[bounded[1]], z[bounded[1]] = x[bounded[1]], 1.5
    lb[bounded[2]] = x[bounded[2]] - 1.0
    M = rng.standard_normal((n, n))
    P, A, G = M @ M.T / n + np.eye(n), *rng.standard_normal((2, p, n))
    A, y, v = A[:m], rng.standard_normal(m), np.array([0.7, 1.2, 0.0])
    qp = QP(
        P=csr_array(P), q=-(P @ x + A.T @ y + G.T @ v + z),
        A=csr_array(A), b=A @ x, G=csr_array(G), h=G @ x + [0, 0, 1], lb=lb, ub=ub,
        sets=(Discs(discs, radius), Cones(cones, slope)),
    )  # fmt: skip
    return qp, Solution(status=Status.SOLVED, x=x, y=y, z=v, z_box=z)


#: largest error in x at tol 1e-8
ERROR = {"scs": 1e-6, "cvxpy:SCS": 1e-6}
#: largest error in x of all other solvers: interior-point methods stop at a gap of
#: tol, which permits an angle of √tol between x and z of a disc
OTHER_ERROR = 5e-4
#: solvers whose own test is relative to the largest row; the rows of these QPs differ
#: by a factor of ten
NORMWISE = ("scs", "cvxpy:SCS")
RESIDUAL = dict.fromkeys(NORMWISE, 1e-6)


@pytest.mark.parametrize("name", NATIVE + WILDCARDS)
def test_planted_solutions_of_discs_and_cones_are_reached(name):
    for seed in range(10):
        qp, best = conic_qp(seed)
        s = solver_of(name).prepare(qp, 1e-8)()

        assert kkt_residuals(qp, s).worst <= RESIDUAL.get(name, 1e-7)
        assert s.status is Status.SOLVED
        assert qp.objective(s.x) == pytest.approx(qp.objective(best.x), rel=1e-8)
        assert np.abs(s.x - best.x).max() <= ERROR.get(name, OTHER_ERROR)


@pytest.mark.parametrize("name", ["clarabel", "scs", "qoco"])
def test_a_sequence_changes_radii_and_right_hand_sides(name):
    """Each QP is solved by updating the solver of its predecessor; the last two QPs
    require new solvers.
    """
    qp, _ = conic_qp(1)
    discs, cones = qp.sets[1:]
    larger = replace(discs, radius=2 * discs.radius)
    point = replace(discs, radius=discs.radius * (np.arange(discs.radius.size) > 0))
    steps = [
        qp,
        replace(qp, sets=(qp.box, larger, cones)),
        replace(qp, q=1.1 * qp.q, h=qp.h + 0.1),
        replace(qp, sets=(qp.box, point, cones)),
        replace(qp, sets=(qp.box, discs, replace(cones, slope=1.5 * cones.slope))),
    ]
    prepare = SOLVERS[name].chain(1e-8)
    for one in steps:
        s = prepare(one)()
        assert s.status is Status.SOLVED
        assert kkt_residuals(one, s).worst <= RESIDUAL.get(name, 1e-7)
        alone = SOLVERS[name].prepare(one, 1e-8)()
        assert one.objective(s.x) == pytest.approx(one.objective(alone.x), rel=1e-7)


def test_a_warm_start_is_a_point_of_the_cones():
    """SCS starts from x, slacks and multipliers; computed from the solution, they
    satisfy the KKT conditions.
    """
    for seed in range(10):
        qp, best = conic_qp(seed)
        form = to_cone(qp)
        x, v, slack = form.point(best)

        assert slack == pytest.approx(form.rhs - form.rows @ x, abs=1e-12)
        assert qp.P @ x + qp.q + form.rows.T @ v == pytest.approx(0, abs=1e-12)
        assert slack @ v == pytest.approx(0, abs=1e-12)
        for vector in (v, slack):
            heads, ends = form.heads, form.heads + form.cones
            for first, last in zip(heads, ends, strict=True):
                assert vector[first] >= np.linalg.norm(vector[first + 1 : last]) - 1e-12
        back = form.multipliers(v)
        for name in ("y", "z", "z_box"):
            assert back[name] == pytest.approx(getattr(best, name), abs=1e-12)


def test_a_hundred_thousand_discs_are_converted_without_dense_arrays():
    k = 100_000
    eye, none = eye_array(3 * k, format="csr"), csr_array((0, 3 * k))
    sets = (Discs(np.arange(3 * k).reshape(k, 3), np.ones(k)),)
    qp = QP(P=eye, q=np.ones(3 * k), A=none, b=np.zeros(0), G=none, h=np.zeros(0),
            sets=sets)  # fmt: skip
    with bounded():
        form = to_cone(qp)
        back = form.multipliers(np.ones(form.rhs.size))

    assert form.rows.shape == (4 * k, 3 * k)
    assert (back["z_box"] == -1).all()


def test_degenerate_sets_become_linear_rows():
    """A disc of radius 0 is a point; a cone of slope 0 is x_T = 0 and x_N ≥ 0."""
    qp, _ = conic_qp(0)
    form = to_cone(qp)
    assert form.equalities == qp.b.size + qp.sets[1].index.shape[1] + 2
    assert form.cones.size == 2 * 5
    assert form.inequalities == qp.h.size + qp.sizes["bounds"] + 1


def degenerate():
    """Return min ½‖x‖² − 4x₁ − 4x₂ over ‖(x₂, x₃)‖ ≤ x₁; x* = (4, 4, 0), with
    multiplier zero.
    """
    cone = Cones([[0, 1, 2]], [1.0])
    return QP.from_arrays(np.eye(3), [-4, -4, 0], sets=(cone,))


#: largest error in x at tol 1e-6 and 1e-8, at most 5√tol except for SCS
DEGENERATE = {
    "projected-gradient": (4e-3, 4e-4),
    "nsgs": (4e-3, 4e-4),
    "clarabel": (5e-3, 5e-4),
    "cvxpy:CLARABEL": (5e-3, 5e-4),
    "qoco": (1e-3, 4e-4),
    "cvxpy:QOCO": (1e-3, 4e-4),
    "scs": (1e-6, 1e-8),
    "cvxpy:SCS": (1e-6, 1e-8),
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_the_degenerate_cone_has_half_of_the_accurate_digits(name):
    for tol, error in zip((1e-6, 1e-8), DEGENERATE[name], strict=True):
        s = solver_of(name).prepare(degenerate(), tol)()
        assert s.status is Status.SOLVED
        assert np.abs(s.x - [4, 4, 0]).max() <= error


def turned(angle):
    """Return min ½‖x − c‖² over ‖(x₁, x₂)‖ ≤ 1 and ‖(x₄, x₅)‖ ≤ ½x₃, with c outside
    both sets in the direction `angle`.
    """
    direction = np.array([np.cos(angle), np.sin(angle)])
    q = -np.concatenate([3 * direction, [1.0], 3 * direction])
    sets = (Discs([[0, 1]], [1.0]), Cones([[2, 3, 4]], [0.5]))
    return QP.from_arrays(np.eye(5), q, sets=sets)


@pytest.mark.parametrize("sides", [3, 4, 16, 100])
def test_polygons_are_inside_circles_by_the_error_that_they_state(sides):
    least = 1.0
    for angle in np.linspace(0, 2 * np.pi / sides, 5):
        qp = turned(angle)
        other = mb.polygonal(qp, sides)
        assert SOLVERS["piqp"].declines(other.qp) is None
        s = other.recover(SOLVERS["piqp"].prepare(other.qp, 1e-10)())
        disc, cone = np.linalg.norm(s.x[:2]), np.linalg.norm(s.x[3:]) / (0.5 * s.x[2])
        for reached in (disc, cone):
            assert 1 - other.error - 1e-8 <= reached <= 1 + 1e-8
            least = min(least, reached)
        assert qp.P @ s.x + qp.q + s.z_box == pytest.approx(0, abs=1e-8)
    assert other.error == 1 - np.cos(np.pi / sides)
    assert least <= 1 - 0.99 * other.error


def test_an_answer_over_polygons_is_not_verified_on_circles():
    qp = turned(0.1)
    other = mb.polygonal(qp, 16)
    s = other.recover(mb.solve(other.qp, "clarabel", 1e-8).solution)
    verdict = mb.verify(qp, s.x, s.y, s.z, s.z_box, tol=1e-6).verdict
    assert verdict is not mb.Verdict.VERIFIED


@pytest.mark.parametrize(
    ("index", "sides", "message"),
    [
        ([[0, 1, 2]], 8, "Discs of 3 tangential variables; expected 2"),
        ([[0, 1]], 2, "sides = 2; expected an integer from 3 to 10000"),
        ([[0, 1]], 8.0, "sides = 8.0; expected an integer"),
    ],
)
def test_sets_without_polygons_are_refused(index, sides, message):
    qp = QP.from_arrays(np.eye(4), np.ones(4), sets=(Discs(index, [1.0]),))
    with pytest.raises(mb.InputError, match=re.escape(message)):
        mb.polygonal(qp, sides)
