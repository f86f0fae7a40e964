"""Contact linearisation at the paper's size, and the cost of search per segment."""

from functools import partial

import numpy as np
import pytest

from mortarbench.problems.contact.mortar import mortar
from mortarbench.problems.contact.node_to_segment import node_to_segment
from mortarbench.problems.contact.segment_search import nearest
from mortarbench.problems.contact.surface import surface
from mortarbench.problems.models.beam_ring import model


@pytest.mark.parametrize("method", [node_to_segment, mortar])
def test_ten_linearisations(benchmark, method):
    bodies = model(30, 15, 30, "strain")
    points, (pair,) = bodies.mesh.points, bodies.pairs
    # a beam that sags by up to 0.1 m, as in the paper's ten steps
    sag = np.column_stack([np.zeros(len(points)), -0.025 * points[:, 0] ** 2]).ravel()

    def linearise():
        return [method(points, k / 10 * sag, *pair) for k in range(1, 11)]

    assert len(benchmark(linearise)) == 10


@pytest.mark.parametrize("segments", [100, 1000, 10_000])
def test_search(benchmark, segments):
    """Nodes on a half ring, as many as segments on a bent beam; flanks are far off."""
    theta = np.pi * np.arange(segments) / (segments - 1)
    ring = 0.49 * np.column_stack([np.cos(theta), np.sin(theta)]) + [1.0, 0.0]
    x = 2 * np.arange(segments + 1) / segments
    beam = np.column_stack([x, 0.5 - 0.025 * x**2])

    projection = benchmark(lambda: nearest(ring, surface(beam, "master")))

    assert len(projection.segment) == segments


@pytest.mark.parametrize("method", [node_to_segment, mortar])
def test_cost_per_segment(race, note, method):
    """Exponents of cost against segments, between successive decades."""

    def sides(segments):
        theta = np.pi * np.arange(segments + 1) / segments
        ring = 0.49 * np.column_stack([np.cos(theta), np.sin(theta)]) + [1.0, 0.0]
        x = 2 * np.arange(segments + 1) / segments
        points = np.concatenate([ring, np.column_stack([x, 0.5 - 0.025 * x**2])])
        slave, master = np.arange(2 * segments + 2).reshape(2, -1)
        return points, np.zeros(points.size), slave, master

    sizes = (100, 1000, 10_000)
    inputs = {f"{n} segments": sides(n) for n in sizes}
    medians = race(**{k: partial(method, *v) for k, v in inputs.items()})

    exponents = np.diff(np.log10(list(medians.values())))
    note(f"{method.__name__}: exponents {exponents[0]:.2f}, {exponents[1]:.2f}")
    assert len(exponents) == 2
