"""Bodies torn into subdomains, and their gluing rows."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse import block_diag, csr_array

from mortarbench.problems.fem.mesh import box_grid, rectangle
from mortarbench.problems.feti.subdomains import (
    TornBodies,
)
from mortarbench.problems.feti.tearing import (
    blocks,
    compact_blocks,
)
from tests.support.decomposed_bodies import decomposed_pair, parts_of
from tests.support.glued import decompose, glue, structured_bodies

GLUING = ("orthonormal", "redundant")


def test_blocks_are_as_equal_as_whole_numbers_allow() -> None:
    label = blocks((7, 3), 3).reshape(3, 7)
    sizes = np.bincount(label.ravel()).reshape(1, 3)
    assert sorted(sizes[0]) == [6, 6, 9]
    assert (np.diff(label, axis=0) == 0).all()
    assert blocks((4, 2, 2), 1).tolist() == list(range(16))


def test_cells_not_larger_than_a_block_form_one_block() -> None:
    assert not blocks((8, 5), 8).any()


def test_blocks_of_several_bodies_are_numbered_one_body_after_another() -> None:
    label = structured_bodies([(4, 2), (3, 3), (1, 1)], 2)
    assert label[:8].tolist() == [0, 0, 1, 1] * 2
    assert label[8:17].reshape(3, 3)[0].tolist() == [2, 2, 3]
    assert label[8:17].reshape(3, 3)[2].tolist() == [4, 4, 5]
    assert label[17:].tolist() == [6]


def plane(wide, deep):
    """Return the points of a grid of rectangular cells with given side lengths."""
    axes = (np.append(0, np.cumsum(lengths)) for lengths in (wide, deep))
    return np.stack(np.meshgrid(*axes), axis=-1)


def test_compact_blocks_of_squares_are_squares() -> None:
    found = compact_blocks(plane(np.full(16, 2 / 16), np.full(8, 1 / 8)), 4)

    pairs = set(zip(found.tolist(), blocks((16, 8), 4).tolist(), strict=True))
    assert len(pairs) == found.max() + 1 == 8


def test_compact_blocks_of_long_cells_are_rectangles_about_as_long_as_wide() -> None:
    """If cells are 8 times as long as wide, a block of 2 × 16 cells is a square."""
    mesh = rectangle((0.0, 0.0), (8.0, 1.0), (16, 16))
    label = compact_blocks(mesh.grid, 6)

    assert np.bincount(label).tolist() == [32] * 8
    for block in range(8):
        assert np.ptp(mesh.points[mesh.cells[label == block]], axis=(0, 1)) == (
            pytest.approx([1.0, 1.0])
        )


def test_compact_blocks_of_a_graded_mesh_halve_lengths_not_numbers_of_cells() -> None:
    wide = np.array([1, 1, 1, 1, 1, 1, 6, 1.0])
    label = compact_blocks(plane(wide, np.full(2, 0.5)), 3)

    assert label.tolist() == 2 * [0, 0, 0, 1, 1, 1, 2, 2]


def test_a_compact_block_as_long_as_wide_is_cut_between_rows() -> None:
    found = compact_blocks(plane(np.full(3, 4.0), np.full(4, 3.0)), 3)

    assert found.reshape(4, 3)[:, 0].tolist() == [0, 0, 1, 1]


def boxed(*axes):
    """Return the points of a box grid with given coordinates, one axis per
    direction."""
    sizes = [len(axis) for axis in axes[::-1]]
    return box_grid(*map(np.asarray, axes)).points.reshape(*sizes, 3)


@pytest.mark.parametrize("cells", [(8, 4, 4), (9, 6, 3), (4, 1, 2), (13, 10, 7)])
@pytest.mark.parametrize("most", [1, 2, 3, 4])
def test_boxes_of_cubes_are_cut_as_evenly_as_whole_numbers_allow(cells, most):
    label = compact_blocks(boxed(*(np.arange(n + 1.0) for n in cells)), most)
    even = blocks(cells, most)

    assert sorted(np.bincount(label)) == sorted(np.bincount(even))
    if all(n % most == 0 for n in cells):
        assert (label == even).all()


@pytest.mark.parametrize(
    ("thickness", "layers"), [(4.0, 1), (2.0, 2), (1.0, 4), (0.5, 4)]
)
def test_boxes_of_slender_cells_have_fewer_cells_along_the_longer_sides(
    thickness, layers
):
    x, z = np.arange(9.0), thickness * np.arange(9.0)
    label = compact_blocks(boxed(x, x, z), 4).reshape(8, 8, 8)
    in_plane = 4 if thickness >= 1 else 2

    assert len(set(label[:, 0, 0])) == 8 // layers
    assert len(set(label[0, :, 0])) == len(set(label[0, 0])) == 8 // in_plane


def test_boxes_of_graded_cells_are_compact_everywhere():
    fine = np.array([0, 1, 2, 3, 4, 6, 9, 14, 22, 34.0])
    points = boxed(fine, fine, fine)
    label = compact_blocks(points, 4).reshape(9, 9, 9)

    for part in range(label.max() + 1):
        cells = np.argwhere(label == part)
        low, high = cells.min(axis=0), cells.max(axis=0) + 1
        assert len(cells) == np.prod(high - low)  # a box
        length = fine[high] - fine[low]
        h = length / (high - low)
        assert (high - low <= 4).all()
        # numbers of cells are rounded to half a cell; a single cell cannot be cut
        assert ((length <= 4 * h.min() + h / 2) | (high - low == 1)).all()


@pytest.mark.parametrize("seed", range(5))
def test_rounding_of_lengths_moves_no_cut_of_compact_blocks(seed: int) -> None:
    """In a row of seven equal cells, two grid lines are equally close to the middle."""
    points = plane(np.ones(7), np.ones(2))
    noise = np.random.default_rng(seed).standard_normal(points.shape)
    label = compact_blocks(points + 1e-15 * noise, 3)

    assert label.tolist() == 2 * [0, 0, 0, 1, 1, 1, 1]


def test_rounding_of_points_creates_no_classes_but_another_shape_does() -> None:
    mesh = rectangle((0.3, 0.1), (2.1, 0.7), (6, 2))
    cells, of_one = mesh.cells, np.zeros(12, dtype=np.int64)
    label = blocks((6, 2), 2)
    assert decompose(mesh.points, cells, label, of_one).class_of.tolist() == [0, 0, 0]
    moved = mesh.points.copy()
    moved[6] += 1e-7  # lower right corner of the last block
    assert decompose(moved, cells, label, of_one).class_of.tolist() == [0, 0, 1]
    of_two = np.where(label == 1, 1, 0)
    assert decompose(mesh.points, cells, label, of_two).class_of.tolist() == [0, 1, 0]


def test_a_mirror_image_belongs_to_another_class() -> None:
    points = np.array([[0, 0], [3, 0], [2, 1], [0, 1]], dtype=float)
    mirrored = points * [-1, 1] + [10, 0]
    cells = np.array([[0, 1, 2, 3], [4, 5, 6, 7]])
    of_one = np.zeros(2, dtype=np.int64)
    both = decompose(np.vstack([points, mirrored]), cells, np.arange(2), of_one)
    assert both.class_of.tolist() == [0, 1]


def test_rectangles_form_one_class_and_each_layer_of_the_ring_one_class() -> None:
    domains = decomposed_pair()[2].domains
    assert domains.sizes.size == 1 + 3
    assert domains.class_of.size == 16 * 2 + 18 * 3


def test_the_assembled_torn_stiffness_is_that_of_the_undecomposed_body() -> None:
    bodies, _, pair = decomposed_pair()
    T, domains = pair.torn.spread, pair.domains
    K = block_diag([domains.template(k).K for k in domains.class_of])
    assembled = T.T @ K @ T
    assert abs(assembled - bodies.K).max() < 1e-12 * abs(bodies.K).max()


def test_motions_of_the_kernel_are_orthonormal_and_have_no_energy() -> None:
    domains = decomposed_pair()[2].domains
    for kind in map(domains.template, range(domains.sizes.size)):
        assert_allclose(kind.R.T @ kind.R, np.eye(3), atol=1e-14)
        assert abs(kind.K @ kind.R).max() < 1e-13 * abs(kind.K).max()


@pytest.mark.parametrize("rows", GLUING)
def test_rows_vanish_exactly_on_continuous_supported_displacements(rows: str) -> None:
    bodies, primal, pair = decomposed_pair(rows)
    (B, c, E), T = pair.torn.rows, pair.torn.spread
    scale = pair.torn.problem.contact_scale
    u = np.sin(np.arange(bodies.mesh.dofs) ** 2)
    u[bodies.fixed] = 0
    held = B @ (T @ u)
    assert_allclose(held[:E], 0, atol=1e-9)
    assert_allclose(held[E:], scale * (primal.G @ u), rtol=1e-10)
    assert_allclose(c[E:], scale * primal.h, rtol=1e-12)
    # nothing else is fixed: rank of B_E = torn unknowns − free components
    sizes = np.linalg.svd(B[:E].toarray(), compute_uv=False)
    left = B.shape[1] - int((sizes > 1e-9).sum())
    assert left == bodies.mesh.dofs - primal.b.size


@pytest.mark.parametrize("rows", GLUING)
def test_the_load_is_that_of_the_whole(rows: str) -> None:
    _, primal, pair = decomposed_pair(rows)
    torn = pair.torn
    assert_allclose(torn.spread.T @ torn.f, -primal.q, atol=1e-15)


def test_orthonormal_rows_are_orthonormal_and_of_full_rank() -> None:
    rows, _, E = decomposed_pair()[2].torn.rows
    root_E = np.linalg.norm(rows.toarray(), axis=1)
    B = np.diag(1 / root_E) @ rows.toarray()
    assert_allclose(B[:E] @ B[:E].T, np.eye(E), atol=1e-14)
    assert_allclose(B[E:] @ B[:E].T, 0, atol=1e-14)
    assert_allclose(np.unique(root_E.round(6)), np.sqrt([400.0, 4000.0]).round(6))


def test_a_class_has_its_boundary_and_material() -> None:
    domains = decomposed_pair(most=4)[2].domains
    classes = [domains.template(k) for k in range(domains.sizes.size)]
    beam = classes[0]  # 4 × 4 cells
    assert beam.boundary.size == 2 * 16
    assert_allclose(beam.stiffness, 4000.0)  # E l/F₀
    assert np.unique(np.concatenate([k.stiffness for k in classes])).size == 2


@pytest.mark.parametrize("rows", GLUING)
def test_rows_are_those_of_sparse_algebra_on_the_whole_body(rows: str) -> None:
    """Supports, gluing and contact have the same order and the same signs."""
    bodies, primal, pair = decomposed_pair(rows)
    label = structured_bodies([(32, 4), (36, 6)], 2)
    parts = decompose(bodies.mesh.points, bodies.mesh.cells, label, bodies.body)
    moduli = np.array([m.E for m in bodies.materials]) * bodies.length / bodies.force
    expected = glue(
        parts, load=bodies.f, supports=csr_array(primal.A), supported=primal.b,
        contact=csr_array(primal.G), c=primal.h, E=moduli[bodies.body_of_node],
        rows=rows,
    )  # fmt: skip
    torn, found = pair.torn, pair.torn.rows

    assert found.equalities == expected.equalities
    assert abs(found.B - expected.B).max() <= 1e-14 * abs(expected.B).max()
    assert abs(torn.spread - expected.spread).max() <= 1e-14
    assert_allclose(found.c, expected.c, rtol=1e-14)
    assert_allclose(torn.f, expected.f, rtol=1e-14)
    assert_allclose(torn.problem.contact_scale, expected.scale, rtol=1e-14)
    assert np.array_equal(pair.domains.class_of, parts.class_of)


def test_other_friction_bounds_keep_rows_and_classes() -> None:
    problem = parts_of("contact-patch/friction=tresca/bound=1e5/feti=2/dual")
    torn = TornBodies(problem)
    rows = torn.rows
    other = torn.with_bound(2 * problem.contact.bound)
    assert other.rows is rows
    assert other.domains is torn.domains
    assert (other.problem.contact.bound == 2 * problem.contact.bound).all()


def test_rows_of_a_tangential_vector_have_equal_scales() -> None:
    """Otherwise, a disc of the multipliers would become an ellipse."""
    name = "contact-patch/lower=4/upper=3/friction=tresca/bound=1e5/dim=3/distort=0.2"
    problem = parts_of(f"{name}/feti=2/dual")
    rows, scale = problem.contact.rows, problem.contact_scale
    tangents = scale[-problem.contact.bound.size :].reshape(-1, 2)
    assert (tangents[:, 0] == tangents[:, 1]).all()
    assert np.unique(tangents).size > 1
    assert rows.shape[0] == scale.size
