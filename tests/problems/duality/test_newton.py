"""Newton's method at finite strain with contact: orders, convexity, load steps."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.sparse import csr_array, eye_array

from harness import InputError
from problems.contact.node_to_segment import geometric_stiffness, node_to_segment
from problems.duality import newton
from problems.families.beam_ring import BeamRing
from problems.families.hertz import HertzPlane
from problems.families.patch import ContactPatch
from problems.models import beam_ring, hertz, patch
from solvers.reference.solve import reference_solution


def ring_path(steps=2, contact_stiffness="geometric", contact="nts", size=2):
    return beam_ring._newton_path(
        (size, size, 2 * size, "strain"), (contact, "dual"), steps, "neo-hooke",
        contact_stiffness, reference_solution,
    )  # fmt: skip


def plane_path(**given):
    params = HertzPlane().complete({"n": 3, "kinematics": "finite", **given})
    return hertz._newton_path(tuple(params.items()), reference_solution)


def patch_path(**given):
    params = ContactPatch().complete({"kinematics": "finite", **given})
    return patch._newton_path(tuple(params.items()), reference_solution)


def residuals(path, k=1):
    return np.array([i.residual for i in path.iterations(k)])


def settled(path, k=1):
    """Residuals from the iteration on after which the active rows do not change."""
    active = [i.answer.z > 1e-6 * i.answer.z.max() for i in path.iterations(k)]
    last = max(
        (j for j in range(1, len(active)) if (active[j] != active[j - 1]).any()),
        default=0,
    )
    return residuals(path, k)[last:]


def test_the_geometric_stiffness_is_the_derivative_of_the_contact_forces():
    """Against central differences of Bᵀλ, with gaps of either sign."""
    points = np.array(
        [[0, 0], [1, 0.1], [2, 0], [3, -0.2], [0.5, -0.2], [1.4, 0.3], [2.6, -0.05]]
    )
    slave, master = np.array([4, 5, 6]), np.array([3, 2, 1, 0])
    u = 0.01 * np.random.default_rng(3).normal(size=14)
    multipliers, h = np.array([1.0, 2.0, 3.0]), 1e-6

    def force(u):
        return node_to_segment(points, u, slave, master).B.T @ multipliers

    blocks, components = geometric_stiffness(points, u, slave, master, multipliers)
    whole = np.zeros((14, 14))
    for block, at in zip(blocks, components, strict=True):
        whole[np.ix_(at, at)] += block
    differences = [(force(u + h * e) - force(u - h * e)) / (2 * h) for e in np.eye(14)]

    np.testing.assert_allclose(whole, differences, atol=1e-8)


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
    """Bodies that both deform: what the rows' second derivatives are left out for."""
    ratios = settled(ring_path(contact_stiffness="none"), 2)
    ratios = ratios[-5:] / ratios[-6:-1]

    assert ratios.min() >= 0.01
    assert ratios.max() <= 0.5


def test_two_bodies_with_second_derivatives_converge_quadratically():
    found = settled(ring_path(), 2)

    assert len(found) >= 3
    assert found[1] <= found[0] ** 2
    assert found[2] <= max(10 * found[1] ** 2, 1e-11)


def test_the_equilibrium_does_not_depend_on_how_it_is_found():
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
    """By all eigenvalues; two of these paths have tangents that are not definite."""
    path = path()
    for k in range(1, path.steps + 1):
        for step in path.iterations(k):
            K = step.primal.P.toarray()
            values = np.linalg.eigvalsh(K)
            assert abs(K - K.T).max() <= 1e-13 * values[-1]
            assert values[0] >= -1e-13 * values[-1]


def test_a_tangent_that_is_not_definite_is_clipped_and_counted():
    """Pressed blocks would turn aside, were it not for the contact below them."""
    clipped = [i.clipped for i in patch_path(stretch=0.6).iterations(1)]

    assert clipped[0] == 0
    assert clipped[-1] > 0


@pytest.fixture(scope="module")
def equilibrium():
    """A path, its last configuration and the multipliers (places,) there."""
    path = patch_path(contact="nts")
    last = path.iterations(1)[-1]
    lam = path._at_places(last)
    at = path._configuration(last.answer.x, last.load_factor, last.gaps)
    assert path.residual(at, lam, 1.0) <= newton.SETTLED
    assert lam.min() >= 0
    return path, at, lam


def test_the_residual_holds_the_largest_penetration(equilibrium):
    path, at, lam = equilibrium
    gap = at.gap.copy()
    open_row = int(np.argmin(lam[at.rows.place]))
    gap[open_row] = -0.25
    free = lam.copy()
    free[at.rows.place[open_row]] = 0.0  # no multiplier: it is no gap under one
    balanced = at._replace(gap=gap, r=-(at.rows.B.T @ free[at.rows.place]))
    assert path.residual(balanced, free, 1.0) == pytest.approx(0.25, rel=1e-9)


def test_the_residual_holds_gaps_under_multipliers_by_their_share(equilibrium):
    path, at, lam = equilibrium
    row, other = 0, 1
    pressing = np.zeros_like(lam)
    pressing[at.rows.place[row]], pressing[at.rows.place[other]] = 2.0, 0.5
    gap = np.zeros_like(at.gap)
    r = -(at.rows.B.T @ pressing[at.rows.place])
    for apart, of in ((0.3, row), (0.3, other)):
        at_gap = gap.copy()
        at_gap[of] = apart
        share = pressing[at.rows.place[of]] / 2.0
        found = path.residual(at._replace(gap=at_gap, r=r), pressing, 1.0)
        assert found == pytest.approx(0.3 * share, rel=1e-9)


def test_the_residual_without_contact_forces_is_that_of_the_load(equilibrium):
    """‖r‖ over the load; r on supports does not count."""
    path, at, lam = equilibrium
    load, held = path.bodies.f, path.bodies.B_D.indices
    r = 0.125 * load
    r[held] = 1e6
    found = path.residual(at._replace(gap=0 * at.gap, r=r), 0 * lam, 1.0)
    free = np.delete(np.arange(r.size), held)
    expected = 0.125 * np.linalg.norm(load[free]) / np.linalg.norm(load[free])
    assert found == pytest.approx(expected, rel=1e-12)
    twice = path.residual(at._replace(gap=0 * at.gap, r=r), 0 * lam, 2.0)
    assert twice == pytest.approx(expected / 2, rel=1e-12)


class OneUnknown(newton.NewtonPath):
    """A line search whose energies and gaps are tables over u."""

    def _configuration(self, u, load_factor, gaps):
        energy, gap = self.reference[float(u[0])]
        return configuration(u[0], energy, gap)

    def residual(self, at, lam, load_factor):
        return 1.0


def configuration(u, energy, gap):
    return newton.Configuration(
        u=np.array([float(u)]), rows=None, gap=np.array([gap]),
        cells=SimpleNamespace(energy=0.0), energy=energy, r=np.array([-1.0]),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("table", "length"),
    [
        # slope −1 − 2·½ = −2 from a merit of 0 + 2·½: 1 − 2e-4 is enough at length 1
        ({1.0: (-2.1e-4, -0.5)}, 1.0),
        ({1.0: (-1.9e-4, -0.5), 0.5: (-1.1e-4, -0.5)}, 0.5),
        ({1.0: (-1.9e-4, -0.5), 0.5: (-0.9e-4, -0.5), 0.25: (-1e-4, -0.5)}, 0.25),
        # energy may grow where penetration, times its weight, falls by more
        ({1.0: (0.9, 0.0)}, 1.0),
        ({1.0: (0.9, -0.1), 0.5: (0.5, -0.2)}, 0.5),
        # a gap that opens gains nothing
        ({1.0: (1.1, 5.0), 0.5: (0.9, 0.5)}, 0.5),
    ],
)
def test_a_step_has_to_bring_its_share_of_the_predicted_decrease(table, length):
    path = OneUnknown(bodies=None, cells=None, gaps=None, reference=table)
    posed = SimpleNamespace(
        load_factor=1.0, answer=SimpleNamespace(x=np.array([1.0])), gaps=None
    )
    start = configuration(0.0, 0.0, -0.5)
    at, taken, _ = path._moved(start, posed, np.zeros(1), weight=2.0, best=1.5)
    assert taken == length
    assert at.u[0] == length


def test_a_full_step_that_halves_the_least_residual_is_taken_whatever_it_costs():
    table = {1.0: (9.0, -3.0), 0.5: (-9.0, 0.0)}
    path = OneUnknown(bodies=None, cells=None, gaps=None, reference=table)
    posed = SimpleNamespace(
        load_factor=1.0, answer=SimpleNamespace(x=np.array([1.0])), gaps=None
    )
    start = configuration(0.0, 0.0, -0.5)
    for best, length in ((2.0, 1.0), (1.99, 0.5)):
        _, taken, _ = path._moved(start, posed, np.zeros(1), weight=2.0, best=best)
        assert taken == length


def test_the_penalty_outweighs_every_multiplier_so_far(monkeypatch):
    """The penalty function is exact for weights above ‖λ‖∞, and the last stay."""
    seen, move = [], newton.NewtonPath._moved

    def spied(self, at, posed, lam, weight, best):
        seen.append((lam.max(), weight))
        return move(self, at, posed, lam, weight, best)

    monkeypatch.setattr(newton.NewtonPath, "_moved", spied)
    plane_path().iterations(1)
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


def test_a_load_step_that_fails_comes_in_parts(monkeypatch):
    whole = ring_path(steps=1)
    expected = whole.iterations(1)[-1].answer.x
    beam_ring._newton_path.cache_clear()
    monkeypatch.setattr(newton, "MOST_ITERATIONS", 5)
    path = ring_path(steps=1)

    assert whole.parts(1) == 1
    assert path.parts(1) > 1
    np.testing.assert_allclose(path.iterations(1)[-1].answer.x, expected, atol=1e-9)
    beam_ring._newton_path.cache_clear()


def test_the_line_search_decreases_the_penalty_function():
    """At one load step the first full step lengthens the beam."""
    path = ring_path(steps=1, size=4)
    steps = path.iterations(1)
    weight = 2 * max(i.answer.z.max() for i in steps)
    merit = [
        newton._merit(path._configuration(i.u, 1.0, i.gaps), weight) for i in steps
    ]
    short = [j for j, i in enumerate(steps[:-1]) if i.length < 1]

    assert short
    assert all(merit[j + 1] < merit[j] for j in short)


def test_an_impossible_load_says_where_it_stopped(monkeypatch):
    monkeypatch.setattr(newton, "HALVINGS", 0)
    path = plane_path(n=1, load=1e5, material="svk")

    with pytest.raises(
        InputError,
        match=r"^load step 1 of 1: the last equilibrium is that at the load factor "
        r"[\d.]+; beyond it, at [\d.]+, iteration \d+ ended with a residual of .*: "
        r"cell \d+ is inverted: det F = .*; expected a smaller load",
    ):
        path.iterations(1)


def test_a_load_lost_in_rounding_is_to_be_larger_and_one_beyond_all_smaller(
    monkeypatch,
):
    """A tiny load has an equilibrium, that of linear elasticity; F does not show it."""
    monkeypatch.setattr(newton, "HALVINGS", 0)
    monkeypatch.setattr(newton, "MOST_ITERATIONS", 5)
    with pytest.raises(InputError, match=r"expected a larger load, or kinematics=lin"):
        plane_path(load=1e-3).iterations(1)
    monkeypatch.setattr(newton, "MOST_ITERATIONS", 1)
    with pytest.raises(InputError, match=r"expected a smaller load"):
        plane_path(load=9.0).iterations(1)  # no other test has kept its iterations


def test_an_iteration_that_is_not_there_is_refused():
    count = len(plane_path().iterations(1))

    with pytest.raises(InputError, match=f"newton=99: step 1 has {count} Newton"):
        plane_path().iteration(1, 99)


def test_supports_that_leave_a_rotation_are_refused():
    bodies = beam_ring.model(2, 2, 4, "strain")
    one_node = np.unique(bodies.B_D.indices)[:2]
    rows = csr_array(eye_array(bodies.mesh.dofs, format="csr")[one_node])

    with pytest.raises(InputError, match="supports leave body 'beam' to rotate"):
        newton.translations_left(replace(bodies, B_D=rows))


def test_paths_are_those_of_the_keys():
    """Keys of the family reach the path; other steps are other loads."""
    case = BeamRing().build(
        "dual",
        BeamRing().complete({
            "Nr": 2, "Nh": 2, "steps": 2, "step": 1, "kinematics": "finite",
            "contact_stiffness": "geometric", "newton": 2,
        }),
        reference_solution,
    )  # fmt: skip
    found = ring_path().iteration(1, 2)

    np.testing.assert_array_equal(case.mechanics.primal.q, found.primal.q)


def test_a_node_between_two_segments_keeps_one_of_them():
    """In step 6 a node of this ring is pushed to and fro at a vertex of the beam."""
    path = beam_ring._newton_path(
        (6, 4, 8, "strain"), ("nts", "dual"), 10, "neo-hooke", "geometric",
        reference_solution,
    )  # fmt: skip
    kept = [path.iterations(k)[-1].gaps is not path.gaps for k in (5, 6)]
    last = path.iteration(6)
    _, residual, penetration = path.state(last, last.answer)

    assert kept == [False, True]
    assert residual <= 1e-9
    assert 0 < penetration <= 1e-5


def test_contact_stiffness_needs_bodies_that_supports_hold():
    path = patch_path(contact="nts", contact_stiffness="geometric")

    with pytest.raises(InputError, match="contact alone holds a body is not built"):
        path.iterations(1)
