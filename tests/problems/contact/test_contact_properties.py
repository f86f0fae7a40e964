"""Properties of contact rows for random shapes and displacements of two sides."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from mortarbench.problems.contact.mortar import _dual, cast_rays, mortar, overlaps
from mortarbench.problems.contact.node_to_facet import node_to_facet
from mortarbench.problems.contact.surface import Reach, closest_points, divided, surface


def searched(**drawn):
    """Return a decorator that runs a test on 10 drawn examples, and on 40 if slow."""

    def decorate(check):
        def test(examples):
            settings(max_examples=examples)(given(**drawn)(check))()

        test.__name__, test.__doc__ = check.__name__, check.__doc__
        counts = [10, pytest.param(40, marks=pytest.mark.slow)]
        return pytest.mark.parametrize("examples", counts)(test)

    return decorate


def numbers(shape, low, high):
    return arrays(float, shape, elements=st.floats(low, high))


@st.composite
def sides(draw):
    """Draw a wavy slave near a wavy master; the slave may be longer or shorter than the
    master, and may penetrate it."""
    s, m = draw(st.integers(2, 9)), draw(st.integers(2, 9))
    left, width = draw(st.floats(-0.4, 0.4)), draw(st.floats(0.5, 1.5))
    distance = draw(st.floats(-0.1, 0.4))
    x = left + width * np.linspace(0, 1, s)
    slave = np.column_stack([x, distance + draw(numbers(s, -0.1, 0.1))])
    x = np.linspace(1, 0, m)
    master = np.column_stack([x, draw(numbers(m, -0.1, 0.1))])
    u = draw(numbers(2 * (s + m), -0.02, 0.02))
    return np.concatenate([slave, master]), u, np.arange(s), s + np.arange(m)


METHODS = {
    "segment": node_to_facet,
    "dual": mortar,
    "standard": lambda *side: mortar(*side, basis="standard"),
}


@searched(side=sides())
def test_rows_are_invariant_under_translations(side):
    for name, method in METHODS.items():
        B, c, *_ = method(*side)
        forces = B.toarray().reshape(len(c), len(side[0]), 2)

        assert np.isfinite(c).all(), name
        # if only a small part of a segment is covered, large entries cancel
        size = 1 + np.abs(forces).sum(axis=(1, 2))[:, None]
        assert (abs(forces.sum(axis=1) / size) <= 1e-14).all(), name


def inside_segments(rows, x, slave, master):
    """Return a mask of the rows whose node is opposite the inside of a segment, and
    whose facets do not extend beyond the master."""
    at = closest_points(x[slave], divided(surface(x[master], "master")))
    inside = (at.N > 0).all(axis=1)
    outside = np.pad(at.beyond > 0, 1)
    inside &= ~(outside[:-2] | outside[2:])
    return inside[rows.place]


@searched(side=sides())
def test_forces_of_a_node_inside_a_segment_have_no_moment(side):
    points, u, slave, master = side
    rows = node_to_facet(*side)
    x = points + u.reshape(-1, 2)
    inside = inside_segments(rows, x, slave, master)

    forces = rows.B.toarray().reshape(rows.c.size, -1, 2)
    moment = forces[..., 1] @ x[:, 0] - forces[..., 0] @ x[:, 1]
    assert moment[inside] == pytest.approx(0, abs=1e-14)


@searched(side=sides())
def test_forces_of_a_mortar_row_have_no_moment(side):
    points, u, slave, master = side
    x = points + u.reshape(-1, 2)
    s, m = surface(x[slave], "slave"), surface(x[master], "master")
    at = cast_rays(s, m, overlaps(s, m), Reach())
    for basis, phi in (("dual", _dual(at)), ("standard", None)):
        B, c, *rest = METHODS[basis](*side)
        moments = B.toarray().reshape(len(c), -1, 2) * np.column_stack(
            [-x[:, 1], x[:, 0]]
        )

        # if a small part of a segment is covered, ∫|Φ_j| is large compared with ∫N_j
        terms = 1 + np.abs(moments).sum(axis=(1, 2))
        if phi is not None:
            sums = np.zeros(len(slave))
            j = s.facets[at.slave]
            np.add.at(sums, j, np.einsum("pgj,pg->pj", np.abs(phi), at.weight))
            share, place = rest[2:4]
            terms += sums[place] / share
        assert (np.abs(moments.sum(axis=(1, 2))) <= 1e-14 * terms).all(), basis


@searched(side=sides(), seed=st.integers(10, 10**6))
def test_numbering_of_the_nodes_does_not_matter(side, seed):
    points, u, slave, master = side
    number = np.random.default_rng(seed).permutation(len(points))
    renamed, v = np.empty_like(points), np.empty_like(points)
    renamed[number], v[number] = points, u.reshape(-1, 2)
    columns = (2 * number[:, None] + [0, 1]).ravel()
    other = renamed, v.ravel(), number[slave], number[master]
    for name, method in METHODS.items():
        B, c, *_ = method(*side)
        B_renamed, c_renamed, *_ = method(*other)

        assert (abs(c_renamed - c) <= np.maximum(1e-12 * abs(c), 1e-13)).all(), name
        assert (abs(B_renamed.toarray()[:, columns] - B.toarray()) <= 1e-14).all(), name


@searched(side=sides())
def test_rows_at_the_ends_of_a_straight_master_have_no_moment(side):
    """The shares of the rows sum to the covered length."""
    points, _, slave, master = side
    x = points.copy()
    x[:, 1] = 0.1 * (np.arange(len(x)) < slave.size)
    rows = node_to_facet(x, np.zeros(x.size), slave, master)
    low = np.maximum(x[slave, 0].min(), x[master, 0].min())
    high = np.minimum(x[slave, 0].max(), x[master, 0].max())
    forces = rows.B.toarray().reshape(rows.c.size, -1, 2)
    size = np.diff(x[slave, 0]).max(initial=0)

    # nodes up to 1e-9 segments beyond an end are moved onto the end
    assert forces[..., 1] @ x[:, 0] == pytest.approx(0, abs=2e-9)
    assert rows.c == pytest.approx(0.1)
    # nodes up to a tenth of a segment beyond an end keep the whole length of the node
    assert abs(rows.share.sum() - max(high - low, 0)) <= 0.2 * size


@searched(side=sides())
def test_the_gap_is_the_slack_of_the_row_at_the_linearisation_point(side):
    """Where the closest point is inside a segment, |c − B u| is the distance to the
    master."""
    points, u, slave, master = side
    rows = node_to_facet(*side)
    x = points + u.reshape(-1, 2)
    inside = inside_segments(rows, x, slave, master)

    edge = np.diff(x[master], axis=0)
    offset = x[slave][:, None] - x[master][:-1]
    xi = np.clip(np.einsum("sex,ex->se", offset, edge) / (edge**2).sum(axis=1), 0, 1)
    distance = np.linalg.norm(offset - xi[..., None] * edge, axis=-1).min(axis=1)
    gap, place = abs(rows.c - rows.B @ u)[inside], rows.place[inside]
    assert gap == pytest.approx(distance[place], abs=1e-14)
