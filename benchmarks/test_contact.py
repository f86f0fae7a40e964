"""Times of contact linearisation in two and three dimensions, and of contact search."""

from functools import partial

import numpy as np
import pytest

from mortarbench.problems.contact.face_mortar import face_mortar
from mortarbench.problems.contact.mortar import mortar
from mortarbench.problems.contact.node_to_facet import node_to_facet
from mortarbench.problems.contact.surface import closest_points, divided, surface
from mortarbench.problems.families.beam_ring import model
from mortarbench.problems.fem.elasticity import (
    Material,
    elasticity_matrix,
    stiffness,
)
from mortarbench.problems.fem.inverse import regular_inverse
from mortarbench.problems.fem.mesh import box, join, prefixed


@pytest.mark.parametrize("method", [node_to_facet, mortar])
def test_ten_linearisations(benchmark, method):
    bodies = model(30, 15, 30, "strain")
    points, (pair,) = bodies.mesh.points, bodies.pairs
    # the beam sags by up to 0.1 m, as in the paper's ten steps
    sag = np.column_stack([np.zeros(len(points)), -0.025 * points[:, 0] ** 2]).ravel()

    def linearise():
        return [method(points, k / 10 * sag, *pair) for k in range(1, 11)]

    assert len(benchmark(linearise)) == 10


@pytest.mark.parametrize("segments", [100, 1000, 10_000])
def test_search(benchmark, segments):
    """Project the nodes of a half ring onto as many segments of a bent beam.

    The nodes on the flanks of the ring are far from the beam.
    """
    theta = np.pi * np.arange(segments) / (segments - 1)
    ring = 0.49 * np.column_stack([np.cos(theta), np.sin(theta)]) + [1.0, 0.0]
    x = 2 * np.arange(segments + 1) / segments
    beam = np.column_stack([x, 0.5 - 0.025 * x**2])

    projection = benchmark(
        lambda: closest_points(ring, divided(surface(beam, "master")))
    )

    assert len(projection.facet) == segments


@pytest.mark.parametrize("method", [node_to_facet, mortar])
def test_cost_per_segment(race, note, method):
    """Report the growth exponents of the time in the number of segments, by decade."""

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


@pytest.mark.parametrize("cells", [15, 24])
def test_linearisation_in_3d_against_a_factorisation(race, note, cells):
    """Linearise contact of two stacked cubes with non-matching meshes.

    The lower cube has fewer cells. Times are compared with a sparse factorisation.
    """
    lower = prefixed(box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (cells - 1,) * 3), "lower_")
    upper = prefixed(box((0.0, 0.0, 1.0), (1.0, 1.0, 1.0), (cells,) * 3), "upper_")
    mesh, _ = join((lower, upper))
    slave, master = mesh.boundaries["upper_bottom"], mesh.boundaries["lower_top"]
    u = 1e-3 * np.sin(5 * mesh.points).ravel()
    K = stiffness(mesh, elasticity_matrix(Material(E=1.0, nu=0.3), None))
    free = np.flatnonzero(np.repeat(abs(mesh.points[:, 2] - 1) < 1, 3))

    medians = race(
        factor=lambda: regular_inverse(K, free),
        node_to_face=lambda: node_to_facet(mesh.points, u, slave, master),
        face_mortar=lambda: face_mortar(mesh.points, u, slave, master),
        rounds=3,
    )

    shares = {k: 100 * t / medians["factor"] for k, t in medians.items()}
    note(
        f"{mesh.dofs} components: node to face {shares['node_to_face']:.1f} %, face "
        f"mortar {shares['face_mortar']:.1f} % of a factor"
    )
    assert len(shares) == 3
