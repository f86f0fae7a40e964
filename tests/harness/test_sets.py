"""Operations of convex sets, compared with definitions; QPs with several sets."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy.optimize import nnls
from scipy.sparse import csr_array

import mortarbench as mb
from mortarbench.harness import (
    QP,
    Box,
    Cones,
    Discs,
    InputError,
    Solution,
    Status,
)
from mortarbench.harness.files.qpfile import qp_digest
from mortarbench.harness.verify.measure import SolverError, reason_to_decline
from tests.support.balls import Balls

N = 8
INF = np.inf
BOX = Box(
    np.array([-1, 0, -INF, -INF, 2, 0, -3, -INF]),
    np.array([1, INF, 0, INF, 2, 5, INF, 7]),
)
BALLS = Balls(np.array([[1, 4], [6, 2]]), np.array([2.0, 0.5]))
CONES = Cones([[1, 4, 5], [6, 2, 0]], [0.5, 2.0])
FLAT = Cones([[3, 7], [5, 0], [2, 6]], [0.0, 1.0, 1e-8])
SETS = [BOX, BALLS, Discs(BALLS.index, BALLS.radius), CONES, FLAT]
NAMES = ["box", "balls", "discs", "cones", "flat cones"]
names = pytest.mark.parametrize("one", SETS, ids=NAMES)
#: bound on the rounding error of a projection onto an unbounded set, for points with
#: components up to 16
ROUNDING = {Cones: 16 * 2.0**-52}


def points(rng, count=200):
    return 4 * rng.standard_normal((count, N))


@names
def test_the_projection_is_the_nearest_point(one, rng):
    members = [one.project(x) for x in points(rng)]
    rounding = ROUNDING.get(type(one), 1e-15)
    for x in points(rng, 50):
        nearest = one.project(x)
        assert all((x - nearest) @ (y - nearest) <= 1e-12 for y in members)
        assert one.project(nearest) == pytest.approx(nearest, rel=0, abs=rounding)
        assert min(limit.slack.min() for limit in one.limits(nearest)) >= -rounding


@names
def test_the_removed_part_of_a_projection_is_normal(one, rng):
    """By Moreau's theorem, z = v − Π(v) is normal at x = Π(v), so that σ(z) = zᵀx."""
    for v in points(rng, 100):
        x = one.project(v)
        z = v - x
        rounding = ROUNDING.get(type(one), 0)
        assert one.admissible(z) == pytest.approx(z, rel=0, abs=rounding)
        gaps = one.support_gaps(x, z, one.limits(x))
        assert max(np.abs(gap).max() for gap in gaps) <= max(1e-14, 16 * rounding)
        assert one.support(z) == pytest.approx(z @ x, abs=1e-13)


@names
def test_the_support_function_bounds_the_work_on_every_member(one, rng):
    members = [one.project(x) for x in points(rng)]
    for z in points(rng, 50):
        z = one.admissible(z)
        sigma = one.support(z)
        assert all(z @ y <= sigma + 1e-12 for y in members)
        for y in members[:20]:
            gaps = one.support_gaps(y, z, one.limits(y))
            total = sum(gap.sum() for gap in gaps)
            assert total == pytest.approx(sigma - z @ y, abs=1e-12)


@names
def test_exactly_members_have_no_negative_slack(one, rng):
    for x in [*points(rng, 50), *map(one.project, points(rng, 50))]:
        slack = min(limit.slack.min() for limit in one.limits(x))
        assert (slack < 0) == (np.abs(one.project(x) - x).max() > 0) or abs(
            slack
        ) < 1e-14


@pytest.mark.parametrize("one", SETS[2:], ids=NAMES[2:])
def test_no_member_is_beyond_a_tangent_plane(one, rng):
    """nᵀ(y − x) ≤ slack for all members y; a plane at the boundary has no slack."""
    members = np.array([one.project(y) for y in points(rng)])
    for v in points(rng, 50):
        x = one.project(v)
        normals, slack = one.normals(x)
        assert ((members - x) @ normals <= slack + 1e-12).all()
        blocks, k = one.index, len(one.index)
        moved = (x != v)[blocks].any(axis=1) & (x[blocks[:, -1]] != 0)  # not at an apex
        assert np.abs(slack[:k][moved]).max(initial=0) <= 1e-14
        length = np.sqrt((normals.toarray() ** 2).sum(axis=0))
        assert length[:k][moved] == pytest.approx(1)


@pytest.mark.parametrize("one", [CONES, Cones([[3, 7], [5, 0]], [1.0, 0.25])])
def test_normals_at_the_apex_span_the_polar_cone(one, rng):
    """Sixteen directions miss a tangential part by at most 1 − cos(π/16)."""
    normals, _ = one.normals(np.zeros(N))
    for v in points(rng, 50):
        z = v - one.project(v)
        assert nnls(normals.toarray(), z)[1] <= 0.02 * np.linalg.norm(z) + 1e-12


def test_bounds_are_substituted_with_their_variables(rng):
    """x = Tx' is in the box exactly if x' is in the other one."""
    T = csr_array(
        (rng.choice([-4.0, -0.5, 2.0], N), (np.arange(N), rng.permutation(N)))
    )
    other = BOX.substituted(T, np.zeros(N))

    assert BOX.block.tolist() == [0, 1, 2, 4, 5, 6, 7]
    for x in points(rng, 50):
        for point in (T @ x, BOX.project(T @ x)):
            back = np.linalg.solve(T.toarray(), point)
            inside = (BOX.project(point) == point).all()
            assert inside == (other.project(back) == back).all()


@names
def test_inadmissible_vectors_have_unbounded_work(one, rng):
    """σ(z) = ∞ for each vector z = ±eⱼ whose admissible part is zero."""
    e = np.eye(N)
    for z in (*e, *-e):
        if not one.admissible(z).any():
            reached = max(z @ one.project(1e9 * z + x) for x in points(rng, 5))
            assert reached > 1e8
    for z in points(rng, 50):  # the inadmissible part of z is a recession direction
        rest = z - one.admissible(z)
        far = one.project(1e9 * rest)
        assert far == pytest.approx(1e9 * rest + one.project(0 * z), abs=1e-5)


@names
def test_the_hull_is_the_smallest_box_around_a_set(one):
    lower, upper = one.hull(N)
    for j in range(N):
        for bound, sign in ((lower[j], -1), (upper[j], 1)):
            far = one.project(sign * 1e9 * np.eye(N)[j])[j]
            if isinstance(one, Cones) and np.isinf(bound):  # t shrinks by μ²/(1 + μ²)
                assert sign * far >= 1e9 * 1e-16
            else:
                assert far == pytest.approx(max(min(bound, 1e9), -1e9))


@pytest.mark.parametrize("slope", [1e-150, 1e-8, 1.0, 1e8, 1e150])
@pytest.mark.parametrize("size", [1e-8, 1.0, 1e8])
def test_steep_and_flat_cones_are_projected_to_the_last_digits(slope, size):
    cone, rng = Cones([[0, 1, 2]], [slope]), np.random.default_rng(3)
    for x in rng.standard_normal((50, 3)) * [size, 1, 1]:
        near, far = cone.project(x), cone.admissible(x)
        assert near + far == pytest.approx(x, rel=1e-14, abs=1e-14 * np.abs(x).max())
        assert abs(near @ far) <= 1e-14 * (np.abs(near) @ np.abs(far))
        assert slope * near[0] - np.hypot(*near[1:]) >= -1e-15 * np.hypot(*near[1:])
        assert slope * np.hypot(*far[1:]) + far[0] <= 1e-15 * np.abs(far).max()


def test_blocks_are_substituted_with_their_variables(rng):
    order = rng.permutation(N)
    for one, factors in (
        (Discs(BALLS.index, BALLS.radius), [1, 2, 4, 1, -2, 1, -4, 1]),
        (CONES, [2, 3, 0.5, 1, -2, 2, 4, 1]),
    ):
        factors = np.array(factors, dtype=float)
        if one is CONES:
            factors[[0, 2]] = 0.5, -0.5
        T = csr_array((factors, (np.arange(N), order)), shape=(N, N))
        other = one.substituted(T, np.zeros(N))
        for x in points(rng, 50):
            inside, there = one.project(x), np.linalg.solve(T.toarray(), x)
            slack = [limit.slack for limit in one.limits(inside)]
            back = np.linalg.solve(T.toarray(), inside)
            assert all((limit.slack >= -1e-14).all() for limit in other.limits(back))
            assert len(slack) == len(other.limits(back))
            is_in = [limit.slack >= 0 for limit in one.limits(x)]
            same = [limit.slack >= 0 for limit in other.limits(there)]
            assert np.array_equal(is_in, same)
        with pytest.raises(ValueError, match="cannot be shifted"):
            one.substituted(T, np.eye(N)[one.index[0, 1]])
        factors[one.index[0, 2:]] *= 3
        factors[one.index[0, -1]] *= -3
        T = csr_array((factors, (np.arange(N), order)), shape=(N, N))
        with pytest.raises(ValueError, match="cannot be scaled unevenly"):
            one.substituted(T, np.zeros(N))
    reversed_normal = csr_array(np.diag(np.where(np.arange(N) == 1, -1.0, 1.0)))
    with pytest.raises(ValueError, match="or reversed"):
        CONES.substituted(reversed_normal, np.zeros(N))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: Discs([0, 1], [1.0]),
            r"Discs: index has shape \(2,\); expected \(k, d",
        ),
        (lambda: Cones([[0, 1]], 0.5), r"Cones: slope has shape \(\); expected \(1,\)"),
        (
            lambda: Discs([[0, 1], [2, 3]], [1, -2]),
            r"Discs: radius\[1\] = -2.0; expected",
        ),
        (
            lambda: Cones([[0, 1]], [np.nan]),
            r"Cones: slope\[0\] = nan; expected finite",
        ),
        (
            lambda: Discs([[0.5, 1]], [1]),
            "Discs: index contains a number that is not an in",
        ),
        (
            lambda: Discs([[0, 1], [2]], [1, 1]),
            "Discs: index is ragged; expected an array",
        ),
        (
            lambda: Discs([["a", "b"]], [1]),
            "Discs: index is of type <U1; expected an array",
        ),
    ],
)
def test_invalid_blocks_of_sets_are_refused_in_one_line(make, message):
    with pytest.raises(InputError, match=message) as e:
        make()
    assert "\n" not in str(e.value)


# QPs


def qp_with(*sets, **parts):
    none = np.zeros(0)
    rows = np.zeros((0, N))
    return QP(
        P=np.eye(N), q=np.ones(N), A=rows, b=none, G=rows, h=none, sets=sets, **parts
    )


FREE = Box.unbounded(N)


@pytest.mark.parametrize(
    ("sets", "message"),
    [
        ((BALLS, BALLS), "QP.sets: variable 1 is in two sets"),
        ((Balls(np.array([[0, N]]), np.ones(1)),), "an index too large"),
        ((Discs([[0, N]], [1]),), "Discs: index 8 is out of range; expected 0 … 7"),
        ((Discs([[0, 1], [1, 2]], [1, 1]),), "Discs: variable 1 is listed twice"),
        ((Discs([[4]], [1]), CONES), "QP.sets: variable 4 is in two sets"),
        ((Box(-np.ones(3), np.ones(3)),), r"QP.lb has shape \(3,\), expected \(8,\)"),
    ],
)
def test_sets_that_do_not_fit_are_refused(sets, message):
    with pytest.raises(ValueError, match=message):
        qp_with(*sets)


@dataclass(frozen=True)
class Careless:
    """Solver that declines no QP, without a declaration of sets."""

    def declines(self, qp):
        return None

    def prepare(self, qp, tol):
        x = np.zeros(qp.q.size)
        none = np.zeros(0)
        return lambda: Solution(status=Status.SOLVED, x=x, y=none, z=none, z_box=x)


class Conic(Careless):
    accepts = (Box, Balls)


def test_a_solver_without_a_declaration_accepts_only_bounds():
    qp = qp_with(FREE, BALLS)
    assert (
        reason_to_decline(Careless(), qp) == "does not accept sets of the class Balls"
    )
    assert reason_to_decline(Careless(), qp_with(BOX)) is None
    assert reason_to_decline(Conic(), qp) is None


@pytest.mark.parametrize("accepts", [Box, ["Box"], (Box, "Balls")])
def test_a_declaration_other_than_a_tuple_of_classes_is_named(accepts):
    solver = type("Odd", (Careless,), {"accepts": accepts})()
    with pytest.raises(SolverError, match="expected a tuple of classes, such as"):
        reason_to_decline(solver, qp_with(BOX))


def test_discs_of_one_variable_are_bounds_to_the_last_bit():
    radius = np.array([1 / 3, 0.0, 1e-3])
    lb = BOX.lower.copy()
    lb[[4, 2, 7]] = -INF
    ub = BOX.upper.copy()
    ub[[4, 2, 7]] = INF
    lower, upper = lb.copy(), ub.copy()
    lower[[4, 2, 7]], upper[[4, 2, 7]] = -radius, radius
    discs = Discs([[4], [2], [7]], radius)

    for order in ((discs, Discs(np.zeros((0, 2)), [])), (discs,)):
        qp = qp_with(Box(lb, ub), *order)
        assert len(qp.sets) == 1
        assert qp.lb.tobytes() == lower.tobytes()
        assert qp.ub.tobytes() == upper.tobytes()
        assert qp.sizes == qp_with(Box(lower, upper)).sizes
        assert qp_digest(qp) == qp_digest(qp_with(Box(lower, upper)))
    assert mb.solve(qp, "osqp").verdict is mb.Verdict.VERIFIED
