"""Subdivisions compared with torn meshes."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mortarbench.problems.contact.bodies import structured
from mortarbench.problems.duality.decomposed import subdivided
from mortarbench.problems.fem.mesh import half_disc, half_ring, join, rectangle
from mortarbench.problems.feti.subdomains import subdomain_ranks
from mortarbench.problems.feti.tearing import compact_blocks, joined_labels
from tests.support.decomposed_bodies import parts_of
from tests.support.glued import decompose, structured_bodies

pytestmark = pytest.mark.together

GRIDS = (
    rectangle((0.0, 0.5), (2.0, 0.25), (13, 5)),
    half_ring((1.0, 0.0), (0.3, 0.49), (11, 7)),
    rectangle((0.0, 0.0), (1.0, 1.0), (2, 2)),
)
DISCS = (
    half_disc((0.0, 8.0), np.linspace(-np.pi, 0, 15), 8 * 0.8 ** np.arange(9)),
    half_disc((0.0, -2.0), np.pi * np.linspace(0, 1, 8) ** 2, np.array([2.0, 1.5])),
    half_disc((0.0, 0.0), np.linspace(0, np.pi, 5), np.array([1.0])),
)


def torn(parts, label):
    mesh, body = join(parts)
    return mesh, body, decompose(mesh.points, mesh.cells, label, body)


def grids(most):
    label = structured_bodies([grid.divisions for grid in GRIDS], most)
    return subdivided(structured(*GRIDS), most), *torn(GRIDS, label)


def discs(most):
    label = joined_labels([compact_blocks(disc.grid, most) for disc in DISCS])
    return subdivided(structured(*DISCS), most), *torn(DISCS, label)


@pytest.fixture(
    scope="module",
    params=[(how, n) for how in (grids, discs) for n in (1, 3, 20)],
)
def known(request):
    """Return a subdivision and the torn undivided mesh."""
    how, most = request.param
    return how(most)


def test_torn_nodes_are_numbered_as_in_the_torn_mesh(known):
    of, _, _, whole = known
    assert of.nodes == whole.nodes
    assert_array_equal(of.torn.number, whole.node)
    assert_array_equal(of.torn.subdomain, whole.subdomain)


def test_nodes_of_subdomains_are_counted_before_they_are_listed(known):
    of, _, _, whole = known

    assert_array_equal(of.sizes, np.diff(whole.start))


def test_copies_of_a_node_are_counted_in_the_order_of_their_subdomains(known):
    of, _, _, whole = known
    nodes, multiplicity = of.torn, np.bincount(whole.node)
    shared = np.flatnonzero(nodes.multiplicity > 1)

    assert_array_equal(nodes.multiplicity, multiplicity[whole.node])
    assert_array_equal(
        of.holder(nodes.number[shared], nodes.copy[shared]), nodes.subdomain[shared]
    )
    assert_array_equal(of.index(nodes.number[shared], nodes.copy[shared]), shared)
    for n in np.flatnonzero(multiplicity > 1):
        assert nodes.copy[whole.node == n].tolist() == list(range(multiplicity[n]))


def test_nodes_of_equal_multiplicity_are_counted_from_the_first(known):
    of, _, _, whole = known
    multiplicity = np.bincount(whole.node)
    several = {
        int(m): int((multiplicity == m).sum()) for m in np.unique(multiplicity) if m > 1
    }

    assert dict(of.nodes_by_multiplicity) == several
    for m in several:
        nodes_by_multiplicity = np.flatnonzero(multiplicity == m)
        assert of.before(nodes_by_multiplicity).tolist() == list(
            range(nodes_by_multiplicity.size)
        )


def test_subdomains_have_the_points_cells_and_bodies_of_the_whole(known):
    of, mesh, body, whole = known
    keys = [(of.key(s), b) for s, b in enumerate(of.body.tolist())]
    nodes = np.split(whole.node, whole.start[1:-1])
    # cells in global numbers
    found = [own[of.cells_of(s)] for s, own in enumerate(nodes)]

    for s, own in enumerate(nodes):
        assert_array_equal(of.points_of(s), mesh.points[own])
    assert sum(map(len, found)) == len(mesh.cells)
    rows = {row.tobytes(): b for row, b in zip(mesh.cells, body, strict=True)}
    for cells, b in zip(found, of.body, strict=True):
        assert {rows[row.tobytes()] for row in cells} == {b}
    of_key = {}
    for s, key in enumerate(keys):
        first = of_key.setdefault(key, s)
        assert_array_equal(of.cells_of(s), of.cells_of(first))


def test_sides_of_bodies_and_interfaces_have_subdomains_and_points(known):
    of, mesh, _, whole = known
    multiplicity = np.bincount(whole.node)
    for chain in (*mesh.boundaries.values(), np.flatnonzero(multiplicity > 1)):
        assert_array_equal(of.multiplicity(chain), multiplicity[chain])
        first = np.searchsorted(np.sort(whole.node), chain)
        by_node = whole.subdomain[np.argsort(whole.node, kind="stable")]
        assert_array_equal(of.holder(chain), by_node[first])


def test_glued_nodes_are_those_of_other_subdomains(known):
    of, _, _, whole = known
    own = [set(part) for part in np.split(whole.node, whole.start[1:-1])]
    glued = [sum(n in neighbour for n in mine) for mine, neighbour in _around(own)]
    assert of.glued().tolist() == glued


def _around(own):
    for s, mine in enumerate(own):
        yield mine, set().union(*own[:s], *own[s + 1 :])


def test_sizes_are_balanced_even_if_few_subdomains_have_most_of_the_work():
    """In a graded half disc, subdomains in the middle have long boundaries; most nodes
    are in the others."""
    problem = parts_of("hertz-plane/n=8/halvings=4/feti=16/dual")
    of, rank = problem.layout, subdomain_ranks(problem, 2)

    for held in (of.sizes, of.glued() ** 2):
        by_rank = np.bincount(rank, held)
        assert by_rank.max() < 1.2 * by_rank.mean()
