"""Newton's method at finite strain with contact: convergence, convexity, load steps."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from mortarbench.harness import InputError
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.node_to_facet import (
    geometric_stiffness,
)
from mortarbench.problems.duality import newton
from mortarbench.problems.duality.newton_case import newton_path
from mortarbench.problems.families import beam_ring
from mortarbench.problems.families.beam_ring import BeamRing
from mortarbench.problems.families.hertz import HertzPlane
from mortarbench.problems.families.patch import ContactPatch
from mortarbench.solvers.reference.solve import reference_solution

pytestmark = pytest.mark.together


def ring_path(steps=2, contact_stiffness="geometric", contact="nts", size=2):
    family = BeamRing(
        Nr=size, Nh=size, steps=steps, contact=contact, kinematics="finite",
        contact_stiffness=contact_stiffness,
    )  # fmt: skip
    return family.newton_path(reference_solution)


def plane_path(n=3, **given):
    family = HertzPlane(n=n, kinematics="finite", **given)
    return family.newton_path(reference_solution)


def patch_path(**given):
    family = ContactPatch(kinematics="finite", **given)
    return family.newton_path(reference_solution)


def residuals(path, k=1):
    return np.array([i.residual for i in path.iterations(k)])


def settled(path, k=1):
    """Return the residuals after the last change of the set of active rows."""
    active = [i.answer.z > 1e-6 * i.answer.z.max() for i in path.iterations(k)]
    last = max(
        (j for j in range(1, len(active)) if (active[j] != active[j - 1]).any()),
        default=0,
    )
    return residuals(path, k)[last:]


def test_at_a_vertex_there_is_no_geometric_stiffness():
    points = np.array([[0.0, 0], [1, 0], [2, -1], [1.1, 0.5]])
    blocks, _ = geometric_stiffness(
        points, np.zeros(8), np.array([3]), np.array([2, 1, 0]), np.ones(1)
    )

    assert not blocks.any()


def test_convergence_against_a_plane_is_quadratic():
    found = settled(plane_path())

    assert len(found) >= 3
    assert found[-1] <= 1e-9
    assert (found[1:-1] <= 10 * found[:-2] ** 2).all()


def test_two_bodies_with_linearised_rows_converge_linearly():
    """Both bodies deform, and the second derivatives of the gaps are neglected."""
    ratios = settled(ring_path(contact_stiffness="none"), 2)
    ratios = ratios[-5:] / ratios[-6:-1]

    assert ratios.min() >= 0.01
    assert ratios.max() <= 0.5


def test_two_bodies_with_second_derivatives_converge_quadratically():
    found = settled(ring_path(), 2)

    assert len(found) >= 3
    assert found[1] <= found[0] ** 2
    assert found[2] <= max(10 * found[1] ** 2, 1e-11)


def test_the_equilibrium_does_not_depend_on_the_load_path():
    with_curvature, without = (
        ring_path(contact_stiffness=c).iterations(2)[-1].answer.x
        for c in ("geometric", "none")
    )

    np.testing.assert_allclose(with_curvature, without, atol=1e-9)
    np.testing.assert_allclose(
        ring_path(steps=1).iterations(1)[-1].answer.x, with_curvature, atol=1e-9
    )


@pytest.mark.parametrize(
    "path",
    [
        lambda: ring_path(),
        lambda: ring_path(1, contact_stiffness="none", contact="mortar"),
        lambda: plane_path(load=300.0),
        lambda: patch_path(stretch=0.5, lower=3, upper=2),
    ],
)
def test_no_emitted_qp_has_negative_curvature(path):
    """All eigenvalues are computed; on the path of compressed blocks, some exact
    tangents are indefinite."""
    path = path()
    for k in range(1, path.steps + 1):
        for step in path.iterations(k):
            K = step.primal.P.toarray()
            values = np.linalg.eigvalsh(K)
            assert abs(K - K.T).max() <= 1e-13 * values[-1]
            assert values[0] >= -1e-13 * values[-1]


def test_a_tangent_that_is_not_definite_is_clipped_and_counted():
    """The tangent of compressed blocks is indefinite, because it lacks the contact that
    prevents rotations.
    """
    clipped = [i.clipped for i in patch_path(stretch=0.6).iterations(1)]

    assert clipped[0] == 0
    assert clipped[-1] > 0


@pytest.fixture(scope="module")
def equilibrium():
    """Return a path, its last configuration and the multipliers (places,) there."""
    path = patch_path(contact="nts", lower=2, upper=3)
    last = path.iterations(1)[-1]
    lam = path._at_places(last)
    at = path._configuration(last.answer.x, last.load_factor, last.gaps)
    assert path.residual(at, lam, 1.0) <= newton.TOLERANCE
    assert lam.min() >= 0
    return path, at, lam


def test_the_residual_includes_the_largest_penetration(equilibrium):
    path, at, lam = equilibrium
    gap = at.gap.copy()
    open_row = int(np.argmin(lam[at.rows.place]))
    gap[open_row] = -0.25
    free = lam.copy()
    # without a multiplier, only the penetration counts
    free[at.rows.place[open_row]] = 0.0
    balanced = at._replace(gap=gap, r=-(at.rows.B.T @ free[at.rows.place]))
    assert path.residual(balanced, free, 1.0) == pytest.approx(0.25, rel=1e-9)


@pytest.mark.parametrize("size", [1e-6, 2.0])
def test_the_residual_weights_gaps_by_shares_of_multipliers(equilibrium, size):
    """Shares are relative to the largest multiplier, whatever its size."""
    path, at, lam = equilibrium
    pressing = np.zeros_like(lam)
    pressing[at.rows.place[:2]] = size, 0.25 * size
    r = -(at.rows.B.T @ pressing[at.rows.place])
    for row, share in ((0, 1.0), (1, 0.25)):
        gap = np.zeros_like(at.gap)
        gap[row] = 0.3
        found = path.residual(at._replace(gap=gap, r=r), pressing, 0.0)
        assert found == pytest.approx(0.3 * share, rel=1e-9)


def test_the_residual_without_contact_forces_is_relative_to_the_load(equilibrium):
    """Components of r at supports do not count; without load, the residual is ‖r‖."""
    path, at, lam = equilibrium
    load, held = path.bodies.f, path.bodies.fixed
    r = 0.125 * load
    r[held] = 1e6
    still = at._replace(gap=0 * at.gap, r=r)
    size = 0.125 * np.linalg.norm(np.delete(load, held))
    for factor, expected in ((1.0, 0.125), (2.0, 0.0625), (0.0, size)):
        found = path.residual(still, 0 * lam, factor)
        assert found == pytest.approx(expected, rel=1e-12)


def test_the_qp_of_an_iteration_models_the_potential():
    """At u^j, the quadratic model and Π have equal values and gradients."""
    path = plane_path()
    for i in path.iterations(1):
        at = path._configuration(i.u, i.load_factor, i.gaps)
        value = 0.5 * i.u @ (i.tangent.K @ i.u) - i.tangent.f @ i.u + i.constant
        assert value == pytest.approx(at.energy, rel=1e-9, abs=1e-14)
        assert i.tangent.K @ i.u - i.tangent.f == pytest.approx(at.r, abs=1e-12)
    assert i.u.any()


def curved(path, size):
    """Return the path with a contact stiffness `size` at two components, and the
    components.
    """
    dofs = np.setdiff1d(np.arange(path.bodies.mesh.dofs), path.bodies.fixed)

    def curvature(u, lam):
        return np.array([size * np.eye(2)]), dofs[None, 5:7]

    return replace(path, gaps=path.gaps._replace(curvature=curvature)), dofs[5:7]


def test_contact_stiffness_that_leaves_the_tangent_definite_is_part_of_it():
    path = ring_path(contact_stiffness="none")
    last = path.iterations(2)[-1]
    at = path._configuration(last.u, last.load_factor, last.gaps)
    lam = np.zeros(path._places)
    plain, _, clipped = path._convex(at, lam, None)
    assert clipped == 0
    unit = path.bodies.force / path.bodies.length  # stiffness 1 in Pa·m
    # for the last size, the tangent would be indefinite; the contact stiffness is then
    # raised to a millionth of its magnitude
    for size, expected in ((-1e-3, -1e-3), (1.0, 1.0), (-1e9, 1e3)):
        bent, (i, j) = curved(path, size * unit)
        K, _, clipped = bent._convex(at, lam, bent.gaps.curvature)
        assert clipped == 0  # cell tangents are unchanged
        difference = (K - plain).toarray()
        held = path.bodies.fixed  # ρ, the largest diagonal entry, changes there
        difference[held, held] = 0
        difference[[i, j], [i, j]] -= expected
        assert abs(difference).max() <= 1e-12 * abs(K).max()


def test_contact_stiffness_is_requested_in_units_and_stored_without_units():
    asked = []

    def curvature(u, lam):
        asked.append((u.tolist(), lam.tolist()))
        return np.array([[[1.0, 2.0], [2.0, 7.0]]]), np.array([[2, 0]])

    bodies = SimpleNamespace(length=2.0, force=8.0)
    path = newton.NewtonPath(bodies=bodies, cells=None, gaps=None, reference=None)
    at = SimpleNamespace(u=np.array([1.0, 2.0, 3.0]), rows=None)
    K = path._contact_stiffness(at, np.array([9.0, 0.5, 0.25]), curvature).toarray()
    assert asked == [([2.0, 4.0, 6.0], [72.0, 4.0, 2.0])]
    assert (K == np.array([[7, 0, 2], [0, 0, 0], [2, 0, 1]]) / 4).all()


def test_a_tangent_that_cannot_be_made_convex_ends_the_load_step(monkeypatch):
    path = ring_path()
    last = path.iterations(1)[-1]
    at = path._configuration(last.u, last.load_factor, last.gaps)

    def fails(cells, tangents, positive):
        raise ArithmeticError("never")

    monkeypatch.setattr(newton, "convex_tangent", fails)
    with pytest.raises(newton.NoEquilibriumError, match="never"):
        path._convex(at, np.zeros(path._places), None)


def test_a_wrong_or_missing_answer_ends_the_load():
    path = ring_path()
    last = path.iterations(1)[-1]

    def raising(qp):
        raise ZeroDivisionError("by nothing")

    def wrong(qp):
        s = reference_solution(qp)
        return replace(s, x=s.x + 1)

    for reference, message in (
        (raising, "its QP was not solved: by nothing"),
        (wrong, "its reference solve left a residual of .*, more than"),
    ):
        other = replace(path, reference=reference)
        with pytest.raises(newton.NoEquilibriumError, match=message):
            other._solve(last.primal, other._inverse(last.tangent.K))


@pytest.mark.parametrize("sign", [-1, 1])
def test_rotations_of_either_sign_are_detected(monkeypatch, sign):
    bodies = beam_ring.model(2, 2, 4, "strain")
    one_node = np.unique(bodies.fixed)[:2]
    kernel = newton.null_space

    def turned(A):
        N = kernel(A)
        return sign * N * np.where(N[2] < 0, -1.0, 1.0)

    monkeypatch.setattr(newton, "null_space", turned)
    bodies = replace(bodies, fixed=one_node)
    path = newton.NewtonPath(bodies=bodies, cells=None, gaps=None, reference=None)
    with pytest.raises(InputError, match="supports allow body 'beam' to rotate"):
        path.iterations(1)


def test_the_penalty_exceeds_every_previous_multiplier(monkeypatch):
    """The penalty is exact for weights above ‖λ‖∞, and weights never decrease."""
    seen, move = [], newton.NewtonPath._line_search

    def spied(self, at, posed, lam, weight, best):
        seen.append((lam.max(), weight))
        return move(self, at, posed, lam, weight, best)

    monkeypatch.setattr(newton.NewtonPath, "_line_search", spied)
    plane_path().iterations(1)
    assert len(seen) >= 3
    largest = np.maximum.accumulate([most for most, _ in seen])
    weights = np.array([weight for _, weight in seen])
    assert (largest > 0).all()
    assert weights == pytest.approx(1.5 * largest, rel=1e-12)


def test_a_load_is_settled_by_a_full_step_to_equilibrium_and_no_earlier():
    path = plane_path()
    *before, last = path.iterations(1)
    assert last.length == 1
    assert last.residual <= 2e-9
    assert before
    assert all(i.length < 1 or i.residual > 1e-9 for i in before)


def test_a_failed_load_step_is_subdivided(monkeypatch):
    whole = ring_path(steps=1)
    expected = whole.iterations(1)[-1].answer.x
    monkeypatch.setattr(newton, "MAX_ITERATIONS", 5)
    path = ring_path(steps=1)

    assert whole.parts(1) == 1
    assert path.parts(1) > 1
    np.testing.assert_allclose(path.iterations(1)[-1].answer.x, expected, atol=1e-9)


def test_the_line_search_decreases_the_penalty_function():
    """In a single load step, some step lengths are below 1."""
    path = ring_path(steps=1, size=4)
    steps = path.iterations(1)
    weight = 2 * max(i.answer.z.max() for i in steps)
    merit = [
        newton._merit(path._configuration(i.u, 1.0, i.gaps), weight) for i in steps
    ]
    short = [j for j, i in enumerate(steps[:-1]) if i.length < 1]

    assert short
    assert all(merit[j + 1] < merit[j] for j in short)


def test_the_message_for_an_impossible_load_states_the_last_load_reached(monkeypatch):
    monkeypatch.setattr(newton, "MAX_HALVINGS", 0)
    path = plane_path(n=1, load=1e5, material="svk")

    with pytest.raises(
        InputError,
        match=r"^load step 1 of 1: the largest load factor with an equilibrium was "
        r"[\d.]+; at the load factor [\d.]+, iteration \d+ ended with a residual of "
        r".*: cell \d+ is inverted: det F = .*; expected a smaller load",
    ):
        path.iterations(1)


def test_a_load_whose_strains_are_lost_in_rounding_is_refused(monkeypatch):
    """The equilibrium of linear elasticity exists, but rounding errors of F exceed the
    strains."""
    monkeypatch.setattr(newton, "MAX_HALVINGS", 0)
    monkeypatch.setattr(newton, "MAX_ITERATIONS", 5)
    with pytest.raises(InputError, match=r"expected a smaller .* kinematics=linear"):
        plane_path(load=1e-3).iterations(1)


def test_paths_are_those_of_the_keys():
    """The keys select the path, `step` its load step and `newton` the iteration."""
    family = BeamRing(
        Nr=2, Nh=2, steps=2, step=1, kinematics="finite",
        contact_stiffness="geometric", newton=2,
    )  # fmt: skip
    case = family.build("dual", reference_solution)
    found = ring_path().iteration(1, 2)

    np.testing.assert_array_equal(case.mechanics.primal.q, found.primal.q)


def test_a_node_between_two_segments_keeps_one_of_them():
    """In step 6, a node of the ring alternates between two segments that share a
    vertex."""
    family = BeamRing(Nr=6, Nh=4, kinematics="finite", contact_stiffness="geometric")
    path = family.newton_path(reference_solution)
    kept = [path.iterations(k)[-1].gaps is not path.gaps for k in (5, 6)]
    last = path.iteration(6)
    _, residual, penetration = path.state(last, last.answer)

    assert kept == [False, True]
    assert residual <= 1e-9
    assert 0 < penetration <= 1e-5


def test_contact_stiffness_needs_supported_bodies():
    bodies = ContactPatch(kinematics="finite").finite_bodies()
    path = newton_path(
        bodies, linearisation(bodies, "nts", "dual"), reference_solution,
        material="neo-hooke", contact="nts", stiffness="geometric",
    )  # fmt: skip

    reason = "is not built for bodies supported by contact alone"
    with pytest.raises(InputError, match=reason):
        path.iterations(1)
