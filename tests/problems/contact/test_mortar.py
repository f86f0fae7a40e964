"""Mortar integrals: exact values, invariants, reach and degenerate input."""

import numpy as np
import pytest

from mortarbench.harness import InputError
from mortarbench.problems.contact import mortar as module
from mortarbench.problems.contact.mortar import (
    cast_rays,
    integrate,
    mortar,
    overlaps,
    project,
)
from mortarbench.problems.contact.surface import Reach, surface
from mortarbench.problems.families.beam_ring import model

BASES = ["dual", "standard"]
ANY_ANGLE = Reach(cosine=1.0)


def sides(slave, master):
    return surface(np.asarray(slave, float), "s"), surface(
        np.asarray(master, float), "m"
    )


def rows(slave, master, u=None, **options):
    points = np.concatenate([slave, master])
    u = np.zeros(points.size) if u is None else u
    s = len(slave)
    return mortar(points, u, np.arange(s), np.arange(s, len(points)), **options)


def flat(n, y, *, rightwards, left=0.0, right=1.0):
    x = np.linspace(left, right, n + 1)
    return np.column_stack([x if rightwards else x[::-1], np.full(n + 1, y)])


def along(integrals, n):
    """Return the factors (s, k) of vectors (s, 2k) that are multiples of n."""
    vectors = integrals.toarray().reshape(integrals.shape[0], -1, 2)
    factors = vectors @ n
    assert vectors == pytest.approx(factors[..., None] * n, abs=1e-15)
    return factors


DOWN = np.array([0.0, -1.0])  #: normal of a straight slave that runs rightwards


def turned(x, angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.asarray(x) @ [[c, s], [-s, c]]


def arcs(n, master_share=0.9):
    """Return a slave arc of radius 1 and a master arc of radius 1.05 around it.

    The numbers of segments are n on the slave and master_share·n on the master.
    """

    def bow(n, radius, start, stop):
        t = np.linspace(start, stop, n + 1)
        return radius * np.column_stack([np.sin(t), -np.cos(t)])

    master = bow(round(master_share * n), 1.05, 0.8, -0.8)
    return bow(n, 1.0, -0.7, 0.7), master


# exact numbers --------------------------------------------------------------------


def test_normals_of_a_polyline_by_hand():
    normal = surface(np.array([[0.0, 0], [4, 3], [7, 7]]), "slave").node_normal

    expected = [[3 / 5, -4 / 5], [np.sqrt(0.5), -np.sqrt(0.5)], [4 / 5, -3 / 5]]
    assert normal == pytest.approx(np.array(expected))


def test_a_master_node_is_projected_along_the_normal_field():
    x = np.array([[[0.0, 0.0]], [[4.0, 3.0]]])
    n = np.array([[[3 / 5, -4 / 5]], [[np.sqrt(0.5), -np.sqrt(0.5)]]])

    xi = project(x, n, np.array([[4.0, -2.0]]))
    assert xi == pytest.approx([-0.281575016087237], abs=1e-15)


def test_a_ray_meets_the_master_at_the_intersection_of_the_lines():
    """The ray from the middle of (0, 0)-(2, 0) meets the line through (0, −1) and (2,
    −3)."""
    s, m = sides([[0, 0], [2, 0]], [[2, -3], [0, -1]])
    at = cast_rays(s, m, overlaps(s, m), Reach())

    assert at.xi[0, 1] == pytest.approx(0)
    assert at.beta[0, 1] == pytest.approx(0.5)
    assert at.gap[0, 1] == pytest.approx(2)


def test_integrals_of_a_half_covered_segment():
    s, m = sides([[1, 2], [3, 2]], [[2, 2], [0, 2]])
    part = overlaps(s, m)
    I = integrate(s, m, "standard", Reach())

    assert part.xi == pytest.approx(np.array([[-1, 0]]))
    assert along(I.D, DOWN) == pytest.approx(np.array([[14, 4], [4, 2]]) / 24)
    assert along(I.M, DOWN) == pytest.approx(np.array([[13, 5], [5, 1]]) / 24)
    assert I.cover == pytest.approx([18 / 24, 6 / 24])
    assert I.gap == pytest.approx([0, 0])


@pytest.mark.parametrize("basis", BASES)
def test_a_linear_gap_is_exact_at_the_nodes_with_the_dual_basis(basis):
    """With the dual basis, ∫Φ_j g/∫N_j equals g_j; with the standard basis, it is an
    average of g."""
    slave, master = flat(4, 0.5, rightwards=True), np.array([[2.0, 0.2], [-1.0, -0.1]])
    gap = 0.5 - 0.1 * slave[:, 0]
    _, c, *_ = rows(slave, master, basis=basis)

    if basis == "dual":
        assert c == pytest.approx(gap)
    else:
        assert c[1:4] == pytest.approx(gap[1:4])
        assert c[[0, 4]] == pytest.approx(0.5 - 0.1 * np.array([1 / 12, 11 / 12]))


@pytest.mark.parametrize("basis", BASES)
def test_the_constraint_is_on_the_total_displacement(basis):
    """If a flat slave moves down by u, the gap changes but the inequality does not."""
    slave, master = flat(7, 0.25, rightwards=True), flat(5, 0.0, rightwards=False)
    u = np.zeros((14, 2))
    u[:8, 1] = -0.3
    B, c, *_ = rows(slave, master, basis=basis)
    B_moved, c_moved, *_ = rows(slave, master, u.ravel(), basis=basis)

    assert c == pytest.approx(np.full(8, 0.25))
    assert B_moved.toarray() == pytest.approx(B.toarray())
    assert c_moved == pytest.approx(c)
    assert (c - B @ u.ravel()) == pytest.approx(-0.05)


# invariants -----------------------------------------------------------------------


@pytest.mark.parametrize(
    "right", [0.5, 0.2, 0.05, 1e-6], ids=lambda r: f"to {r} of the last"
)
def test_the_dual_basis_is_biorthogonal_on_the_covered_part(right):
    """On each of four segments, ∫Φ_j N_k = δ_jk ∫N_k; the last segment is only partly
    covered."""
    slave = flat(4, 0.0, rightwards=True, right=4.0)
    s, m = sides(slave, flat(7, -0.1, rightwards=False, left=-1.0, right=3 + right))
    at = cast_rays(s, m, overlaps(s, m), Reach())
    N = np.stack([(1 - at.xi) / 2, (1 + at.xi) / 2], axis=-1)
    phi = module._dual(at)

    for e in range(4):
        on = at.slave == e
        product = np.einsum("pg,pgj,pgk->jk", at.weight[on], phi[on], N[on])
        measure = np.einsum("pg,pgk->k", at.weight[on], N[on])
        assert product / measure[:, None] == pytest.approx(np.eye(2), abs=1e-8)
        assert (product / measure)[[0, 1], [0, 1]] == pytest.approx(1, abs=1e-8)


def test_the_dual_basis_is_biorthogonal_on_curved_sides():
    s, m = sides(*arcs(20))
    at = cast_rays(s, m, overlaps(s, m), Reach())
    N = np.stack([(1 - at.xi) / 2, (1 + at.xi) / 2], axis=-1)
    blocks = np.einsum("pg,pgj,pgk->pjk", at.weight, module._dual(at), N)
    measure = np.einsum("pg,pgk->pk", at.weight, N)

    for e in range(20):
        product, scale = blocks[at.slave == e].sum(axis=0), measure[at.slave == e].sum()
        expected = np.diag(measure[at.slave == e].sum(axis=0))
        assert product / scale == pytest.approx(expected / scale, abs=1e-14)


@pytest.mark.parametrize("angle", [0.0, 0.3, 2.0])
def test_D_of_the_dual_basis_is_diagonal_on_straight_sides_and_equals_the_cover(angle):
    slave, master = flat(20, 0.0, rightwards=True), flat(17, -0.1, rightwards=False)
    I = integrate(*sides(turned(slave, angle), turned(master, angle)), "dual", Reach())
    D = along(I.D, turned(DOWN, angle))

    assert np.count_nonzero(D) == 21
    assert D.diagonal() == pytest.approx(I.cover, rel=1e-13)


def test_a_row_of_the_dual_basis_pulls_the_slave_along_the_normal_of_its_node():
    """For any master mesh, ∫Φ_j ν = n_j ∫N_j, because the quadrature is exact."""
    s, m = sides(*arcs(20))
    edge = np.linalg.norm(np.diff(s.x, axis=0), axis=1)
    share = (np.append(0, edge) + np.append(edge, 0)) / 2
    pull = integrate(s, m, "dual", Reach()).D.toarray().reshape(21, 21, 2).sum(axis=1)

    assert pull == pytest.approx(share[:, None] * s.node_normal, abs=1e-15)


def test_a_tiny_covered_part_keeps_D_equal_to_the_covered_length():
    slave, master = flat(7, 0.0, rightwards=True), [[3 / 7 + 1e-7, 0], [-1, 0]]
    I = integrate(*sides(slave, master), "dual", Reach())

    assert I.cover[4] < 1e-12
    assert along(I.D, DOWN).diagonal() == pytest.approx(I.cover, rel=1e-7, abs=0)


@pytest.mark.parametrize("basis", BASES)
def test_a_flat_non_matching_side_carries_constants_and_linears(basis):
    slave, master = flat(10, 0.0, rightwards=True), flat(9, 0.0, rightwards=False)
    I = integrate(*sides(slave, master), basis, Reach())
    carried = np.linalg.solve(along(I.D, DOWN), along(I.M, DOWN))

    assert carried @ np.ones(10) == pytest.approx(np.ones(11), abs=1e-13)
    assert carried @ master[:, 0] == pytest.approx(slave[:, 0], abs=1e-13)


def test_a_segment_covered_in_part_still_carries_linears():
    slave = flat(4, 0.0, rightwards=True)
    master = flat(3, 0.0, rightwards=False, left=0.1, right=0.8)
    I = integrate(*sides(slave, master), "dual", Reach())

    carried = along(I.M, DOWN) @ master[:, 0] / I.cover
    assert carried == pytest.approx(slave[:, 0], abs=1e-13)


@pytest.mark.parametrize("basis", BASES)
def test_the_integrals_cover_a_flat_slave_once(basis):
    s, m = sides(flat(10, 0.0, rightwards=True), flat(7, 0.0, rightwards=False))
    I = integrate(s, m, basis, Reach())

    assert I.cover.sum() == pytest.approx(1)
    assert along(I.D, DOWN).sum() == pytest.approx(1)
    assert along(I.M, DOWN).sum() == pytest.approx(1)


def test_the_rays_of_a_curved_slave_cover_it_once():
    s, m = sides(*arcs(20))
    part = overlaps(s, m)

    covered = np.bincount(part.slave, np.diff(part.xi, axis=1)[:, 0])
    assert covered == pytest.approx(np.full(20, 2.0))


@pytest.mark.parametrize("seed", [271828, 314159, 161803])
def test_the_search_finds_every_overlap(seed, monkeypatch):
    rng = np.random.default_rng(seed)
    slave, master = arcs(70)
    s, m = sides(slave + 0.02 * rng.standard_normal(slave.shape),
                 master + 0.02 * rng.standard_normal(master.shape))  # fmt: skip
    segments = overlaps(s, m)
    pairs = np.divmod(np.arange(70 * 63), 63)
    monkeypatch.setattr(module, "facing_segments", lambda s, m: pairs)

    assert len(segments.slave) > 100
    for one, other in zip(segments, overlaps(s, m), strict=True):
        assert (one == other).all()


def test_tangential_rows_are_those_of_normals_turned_by_a_right_angle():
    B, _, T, *_ = rows(*arcs(20), tangential=True)
    x, y = np.moveaxis(B.toarray().reshape(B.shape[0], -1, 2), 2, 0)

    assert (T.toarray() == np.stack([-y, x], axis=-1).reshape(B.shape)).all()


@pytest.mark.parametrize("basis", BASES)
@pytest.mark.parametrize("n", [5, 40])
def test_on_curved_sides_the_forces_of_a_row_have_no_moment_or_resultant(n, basis):
    """A parabolic master covers a part of each end segment of a circular slave."""
    t, x = np.linspace(-0.6, 0.5, n + 1), np.linspace(0.5, -0.55, 9 * n // 10 + 1)
    slave = np.column_stack([np.sin(t), -np.cos(t)])
    master = np.column_stack([x, 0.1 * x**2 - 1.05])
    B, *_ = rows(slave, master, basis=basis)
    x, y = (np.concatenate([slave, master]) - [2, 1]).T  # far from lines of action
    forces = B.toarray().reshape(B.shape[0], -1, 2)
    moments = forces * np.stack([-y, x], axis=-1)

    terms = np.abs(moments).sum(axis=(1, 2))
    assert (np.abs(moments.sum(axis=(1, 2))) <= 1e-15 * terms).all()
    assert forces.sum(axis=1) == pytest.approx(0, abs=1e-14)
    assert (terms > 1).all()


@pytest.mark.parametrize("basis", BASES)
def test_on_straight_sides_rows_are_those_with_the_normal_outside_of_the_integrals(
    basis,
):
    """The expected rows are n_jᵀ[(D u_s)_j − (M u_m)_j] with scalar D and M, as in
    Popp, Gee and Wall."""
    slave = turned(flat(7, 0.05, rightwards=True), 0.3)
    master = turned(flat(5, 0.0, rightwards=False, left=-0.1, right=0.93), 0.3)
    s, m = sides(slave, master)
    at = cast_rays(s, m, overlaps(s, m), Reach())
    shapes = [np.stack([1 - z, z], axis=-1) for z in ((1 + at.xi) / 2, at.beta)]
    phi = module._dual(at) if basis == "dual" else shapes[0]
    expected, cover = np.zeros((8, 14)), np.zeros(8)
    for p, (e, f) in enumerate(zip(at.slave, at.master, strict=True)):
        for first, shape, sign in ((e, shapes[0], 1), (8 + f, shapes[1], -1)):
            block = np.einsum("g,gj,gk->jk", at.weight[p], phi[p], shape[p])
            expected[e : e + 2, first : first + 2] += sign * block
        cover[e : e + 2] += at.weight[p] @ shapes[0][p]
    B, c, *_ = rows(slave, master, basis=basis)
    scalars = expected / cover[:, None]

    vectors = scalars[..., None] * turned(DOWN, 0.3)
    assert B.toarray().reshape(8, 14, 2) == pytest.approx(vectors, abs=1e-15)
    assert c == pytest.approx(np.full(8, 0.05), abs=1e-15)


# geometry and reach of the benchmark --------------------------------------------------


@pytest.mark.parametrize("basis", BASES)
@pytest.mark.parametrize(
    "mesh",
    [(10, 5, 10), (30, 15, 30),
     *((Nr, Nh, 1) for Nr in (1, 2, 5, 8) for Nh in (1, 2, 3, 7))],
)  # fmt: skip
def test_before_loading_no_weighted_gap_of_the_paper_is_negative(mesh, basis):
    """Beam and ring are 0.01 m apart, and chords of the arc are farther from the beam
    than the arc."""
    bodies = model(*mesh, "strain")
    points, (pair,) = bodies.mesh.points, bodies.pairs
    B, c, *_ = mortar(points, np.zeros(points.size), *pair.sides, basis=basis)

    assert 0 < B.shape[0] < len(pair.slave)  # the flanks face nothing
    assert c.min() > (0.0099 if mesh[1] > 1 else 0.0098)


def test_rays_that_graze_a_far_master_would_give_negative_weighted_gaps():
    """The slave is three quarters of a circle, 1 cm above a plate of 200 km length."""
    theta = np.linspace(-0.75 * np.pi, 0.75 * np.pi, 61)
    arc = np.column_stack([np.sin(theta), -np.cos(theta)])
    plate = np.array([[1e5, -1.01], [-1e5, -1.01]])

    def least_gap(cosine, basis):
        return rows(arc, plate, basis=basis, reach=Reach(cosine, 1e9))[1].min()

    assert least_gap(1.0, "dual") < -1
    assert least_gap(1.0, "standard") > 0.0099  # an average is not negative
    assert least_gap(-0.5, "dual") > 0.0099


@pytest.mark.parametrize(("distance", "kept"), [(0.2, 0), (0.35, 1)])
def test_a_segment_that_is_partly_out_of_reach_does_not_count(distance, kept):
    """The slave extends from 0 to 1; the master above it rises from 0.1 to 0.3."""
    s, m = sides([[1, 0], [0, 0]], [[0, 0.1], [1, 0.3]])
    at = cast_rays(s, m, overlaps(s, m), Reach(distance=distance, cosine=1.0))

    assert len(at.slave) == kept


@pytest.mark.parametrize("height", [0.25, -0.25], ids=["apart", "overlapping"])
@pytest.mark.parametrize(("distance", "kept"), [(0.3, 8), (0.2, 0)])
def test_segments_farther_than_the_reach_do_not_count(distance, kept, height):
    B, c, *_ = rows(flat(7, height, rightwards=True), flat(5, 0.0, rightwards=False),
                reach=Reach(distance=distance))  # fmt: skip

    assert B.shape == (kept, 28)
    assert c.shape == (kept,)


def test_only_covered_nodes_get_a_row():
    """The master ends within the fifth of ten segments, so that nodes 0 to 5 are
    covered."""
    B, *_ = rows(flat(10, 0.1, rightwards=True),
                flat(3, 0.0, rightwards=False, right=0.45))  # fmt: skip

    assert B.shape[0] == 6
    assert np.unique(B[:, :22].nonzero()[1] // 2).tolist() == [0, 1, 2, 3, 4, 5]


@pytest.mark.parametrize("basis", BASES)
def test_sides_beside_each_other_have_no_row(basis):
    slave = flat(3, 0.1, rightwards=True)
    master = flat(3, 0.0, rightwards=False, left=2, right=3)
    I = integrate(*sides(slave, master), basis, Reach())

    assert rows(slave, master, basis=basis).B.shape == (0, 16)
    assert (I.D.nnz, I.M.nnz) == (0, 0)
    assert I.gap.dtype == I.cover.dtype == float


# degenerate input -----------------------------------------------------------------


@pytest.mark.parametrize("basis", BASES)
def test_a_reversed_side_has_no_contact_rows(basis):
    slave, master = flat(7, 0.25, rightwards=True), flat(5, 0.0, rightwards=False)

    assert rows(slave[::-1], master, basis=basis).B.shape == (0, 28)
    assert rows(slave, master[::-1], basis=basis).B.shape == (0, 28)


@pytest.mark.parametrize("basis", BASES)
def test_segments_without_length_change_no_gap_and_no_force(basis):
    slave, master = flat(2, 0.25, rightwards=True), flat(3, 0.0, rightwards=False)
    once, c, *_ = rows(slave, master, basis=basis)
    twice, c_twice, *_ = rows(np.repeat(slave, [1, 2, 1], axis=0),
                          np.repeat(master, 2, axis=0), basis=basis)  # fmt: skip

    assert np.isfinite(twice.toarray()).all()
    assert c_twice == pytest.approx(np.full(4, 0.25))
    on_master = twice.toarray()[[0, 3], 8:].reshape(2, 4, 2, 2).sum(axis=2)
    assert on_master.reshape(2, 8) == pytest.approx(once.toarray()[[0, 2], 6:])
    assert len(c) == 3


@pytest.mark.parametrize("basis", BASES)
@pytest.mark.parametrize("shape", ["needle", "zigzag", "touching", "focus"])
def test_odd_shapes_give_finite_rows(shape, basis):
    slave, master = {
        "needle": ([[0, 0], [1, 0], [0, 0]], [[2, -1], [-1, -1]]),
        "zigzag": ([[0, 0], [1, 0], [0.5, 0], [1.5, 0]],
                   [[2, -1], [1, -1], [1.5, -1], [-1, -1]]),
        "touching": ([[0, 0], [1, 0], [2, 0]], [[2, 0], [1, 0], [0, 0]]),
        # the master is beyond the point where the normals of the slave meet
        "focus": ([[-1, 0.2], [0, 0], [1, 0.2]], [[2, 9], [-2, 9]]),
    }[shape]  # fmt: skip
    B, c, *_ = rows(np.array(slave, float), np.array(master, float), basis=basis,
                reach=ANY_ANGLE)  # fmt: skip

    assert np.isfinite(B.toarray()).all()
    assert np.isfinite(c).all()
    assert B.toarray()[:, ::2].sum(axis=1) == pytest.approx(0, abs=1e-12)


def test_a_master_deeper_than_the_focus_of_the_normals_is_not_met():
    s, m = sides([[-1, 0.2], [0, 0], [1, 0.2]], [[2, 20], [-2, 20]])

    assert len(overlaps(s, m).slave) == 0


@pytest.mark.parametrize("across", [-0.1, 0.1])
@pytest.mark.parametrize("downwards", [True, False])
def test_a_master_through_the_focus_of_the_normals_is_met_below_it(across, downwards):
    """The nodal normals of the middle segment are inclined by 22.5° and meet at (0,
    1 + √2)."""
    master = np.array([[across, 9.0], [across, -1.0]])
    s, m = sides([[-2, 1], [-1, 0], [1, 0], [2, 1]],
                 master if downwards else master[::-1])  # fmt: skip
    part = overlaps(s, m)
    below = across / np.sqrt(2)  # the ray of ξ is at √2 ξ where y = −1

    (xi,) = part.xi[part.slave == 1]
    assert xi == pytest.approx(sorted([below, np.sign(across)]))


@pytest.mark.parametrize("side", ["slave", "master"])
def test_a_side_without_a_segment_is_refused(side):
    chains = {
        "slave": flat(2, 0.1, rightwards=True),
        "master": flat(2, 0.0, rightwards=False),
    }
    chains[side] = chains[side][[0, 0]]

    with pytest.raises(InputError, match=f"contact {side}: 2 node"):
        rows(chains["slave"], chains["master"])
