"""Closest points of chains and facing segments, compared with all pairs."""

import numpy as np
import pytest

from mortarbench.harness import InputError
from mortarbench.problems.contact import surface as module
from mortarbench.problems.contact.mortar import facing_segments
from mortarbench.problems.contact.surface import Reach, closest_points, divided, surface


@pytest.fixture(autouse=True, params=[0, module.MAX_PAIRS], ids=["tree", "pairs"])
def search(request, monkeypatch):
    """Search the closest facets by a tree, or among all pairs."""
    monkeypatch.setattr(module, "MAX_PAIRS", request.param)


def all_pairs(x, chain):
    """Return the distances (s, e) of all points from all segments."""
    edge = np.diff(chain, axis=0)
    offset = x[:, None] - chain[:-1]
    xi = np.einsum("sex,ex->se", offset, edge) / (edge**2).sum(axis=1)
    return np.linalg.norm(offset - np.clip(xi, 0, 1)[..., None] * edge, axis=-1)


def nearest(x, chain):
    return closest_points(x, divided(surface(chain, "master")))


def arc(n, radius=0.49, centre=(1.0, 0.0)):
    theta = np.pi * np.arange(n + 1) / n
    return centre + radius * np.column_stack([np.cos(theta), np.sin(theta)])


def bent_beam(n):
    x = 2 * np.arange(n + 1) / n
    return np.column_stack([x, 0.5 - 0.05 * x**2])


SIZES = [1, 2, 15, 16, 17, 64, 65, 257]


@pytest.mark.parametrize("segments", SIZES)
@pytest.mark.parametrize("roughness", [0.0, 1e-3, 0.2])
def test_the_closest_segment_of_the_whole_chain_is_found(segments, roughness):
    rng = np.random.default_rng(577215)
    chain = arc(segments) + roughness * rng.standard_normal((segments + 1, 2))
    around = np.concatenate([chain, [[1.0, -0.5]], chain[:1]])  # returns to its start
    x = rng.uniform(-1, 3, (200, 2))
    for one in (chain, around):
        closest = nearest(x, one)
        start, edge = one[closest.facet], np.diff(one, axis=0)[closest.facet]
        reached = np.linalg.norm(x - start - closest.N[:, 1:] * edge, axis=1)
        least = all_pairs(x, one).min(axis=1)
        assert reached == pytest.approx(least, rel=1e-12)


def test_the_closest_segment_is_found_on_a_chain_with_loops():
    square = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    loops = np.concatenate([np.tile(square, (5, 1)), square[:1]])
    closest = nearest(np.array([[0.5, -1], [2, 0.5], [0.5, 0.9]]), loops)

    assert closest.facet.tolist() == [0, 1, 2]


def test_of_two_equally_close_segments_the_first_along_the_chain_is_taken():
    down = np.column_stack([np.zeros(65), np.arange(64, -1, -1.0)])
    corner = np.concatenate([down, down[-2::-1, ::-1]])  # (0, 64) → origin → (64, 0)
    closest = nearest(np.array([[20.5, 20.5]]), corner)

    assert (closest.facet.tolist(), closest.N.tolist()) == ([43], [[0.5, 0.5]])


@pytest.mark.parametrize("segments", SIZES)
def test_facing_segments_are_found_among_all_pairs(segments):
    """A slave and a master segment face each other if the master segment has points on
    the inner side of both end normals of the slave segment.

    The side follows from the sign of (x − p) × n.
    """
    rng = np.random.default_rng(577215)
    bent = arc(40) + 0.002 * rng.standard_normal((41, 2))
    slave, master = surface(bent, "s"), surface(bent_beam(segments), "m")

    def side(j, p):
        way = slave.x[j][:, None] - p
        normal = slave.node_normal[j][:, None]
        return way[..., 0] * normal[..., 1] - way[..., 1] * normal[..., 0]

    begins, ends = master.start, master.end
    first, last = slave.facets.T
    first = np.maximum(side(first, begins), side(first, ends)) >= 0
    second = np.minimum(side(last, begins), side(last, ends)) <= 0

    assert np.array_equal(facing_segments(slave, master), np.nonzero(first & second))


@pytest.mark.parametrize("segments", [500, 2000])
def test_few_master_segments_face_a_slave_segment(segments):
    slave, master = surface(arc(segments), "s"), surface(bent_beam(segments), "m")

    assert len(facing_segments(slave, master)[0]) <= 6 * segments


@pytest.mark.parametrize(
    ("wrong", "message"),
    [({"cosine": -1.5}, "cosine=-1.5"), ({"cosine": float("nan")}, "cosine=nan"),
     ({"distance": 0.0}, "distance=0.0"), ({"distance": float("nan")}, "distance=nan")],
)  # fmt: skip
def test_an_invalid_reach_is_refused(wrong, message):
    with pytest.raises(InputError, match=message):
        Reach(**wrong)


def test_by_default_the_larger_side_bounds_the_distance():
    small, large = surface(arc(4, 0.1), "s"), surface(arc(4, 2.0), "m")

    expected = 2 * np.sqrt(5)  # the bounding box of a half circle is 2r × r
    assert Reach().max_distance(small, large) == pytest.approx(expected)
    assert Reach().max_distance(large, small) == pytest.approx(expected)
    assert Reach(distance=0.25).max_distance(small, large) == 0.25
