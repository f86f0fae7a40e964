"""Bodies torn into subdomains, and the rows that hold these together."""

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse import block_diag

from problems.contact.bodies import Bodies
from problems.contact.linearise import linearisation
from problems.duality.stepping import primal_qp
from problems.feti.elastic import subdivide, torn
from problems.feti.tearing import blocks
from problems.feti.torn import Torn
from problems.models.beam_ring import model

GLUING = ("orthonormal", "chain", "redundant")


def beam_and_ring(Nr: int = 4, Nh: int = 3, radial: int = 6) -> Bodies:
    return model(Nr, Nh, radial, "strain")


def labels(bodies: Bodies, Nr: int, Nh: int, radial: int, most: int) -> Any:
    beam = blocks((8 * Nr, Nr), most)
    return np.append(beam, beam.max() + 1 + blocks((12 * Nh, radial), most))


def torn_pair(rows: str = "orthonormal", most: int = 2) -> tuple[Bodies, Any, Torn]:
    bodies = beam_and_ring()
    rough = linearisation(bodies, "mortar", "dual")(np.zeros(bodies.mesh.dofs))
    primal = primal_qp(bodies, rough)
    parts = subdivide(bodies, labels(bodies, 4, 3, 6, most))
    return bodies, primal, torn(parts, primal, rows=rows)


def test_blocks_are_as_equal_as_whole_numbers_allow() -> None:
    label = blocks((7, 3), 3).reshape(3, 7)
    sizes = np.bincount(label.ravel()).reshape(1, 3)
    assert sorted(sizes[0]) == [6, 6, 9]
    assert (np.diff(label, axis=0) == 0).all()
    assert blocks((4, 2, 2), 1).tolist() == list(range(16))


def test_one_block_holds_what_is_not_larger_than_it() -> None:
    assert not blocks((8, 5), 8).any()


def test_rectangles_are_of_one_kind_and_each_layer_of_the_ring_is_of_one() -> None:
    _, _, pair = torn_pair()
    assert len(pair.kinds) == 1 + 3
    assert pair.kind.size == 16 * 2 + 18 * 3


def test_the_torn_stiffness_of_all_subdomains_is_that_of_the_whole() -> None:
    bodies, _, pair = torn_pair()
    K = block_diag([pair.kinds[k].K for k in pair.kind])
    assembled = pair.spread.T @ K @ pair.spread
    assert abs(assembled - bodies.K).max() < 1e-12 * abs(bodies.K).max()


def test_motions_of_the_kernel_are_orthonormal_and_cost_no_energy() -> None:
    for kind in torn_pair()[2].kinds:
        assert_allclose(kind.R.T @ kind.R, np.eye(3), atol=1e-14)
        assert abs(kind.K @ kind.R).max() < 1e-13 * abs(kind.K).max()


@pytest.mark.parametrize("rows", GLUING)
def test_rows_hold_exactly_what_is_whole_and_supported(rows: str) -> None:
    bodies, primal, pair = torn_pair(rows)
    u = np.sin(np.arange(bodies.mesh.dofs) ** 2)
    u[bodies.B_D.indices] = 0
    held = pair.B @ (pair.spread @ u)
    assert_allclose(held[: pair.equalities], 0, atol=1e-9)
    assert_allclose(
        held[pair.equalities :],
        pair.scale[pair.equalities :] * (primal.G @ u),
        rtol=1e-10,
    )
    assert_allclose(
        pair.c[pair.equalities :], pair.scale[pair.equalities :] * primal.h, rtol=1e-12
    )
    # nothing else is held: the torn motions that all equations leave at rest
    B_E = (pair.B[: pair.equalities]).toarray()
    rank = int((np.linalg.svd(B_E, compute_uv=False) > 1e-9).sum())
    left = pair.B.shape[1] - rank
    assert left == bodies.mesh.dofs - primal.b.size


@pytest.mark.parametrize("rows", GLUING)
def test_the_load_is_that_of_the_whole(rows: str) -> None:
    _, primal, pair = torn_pair(rows)
    assert_allclose(pair.spread.T @ pair.f, -primal.q, atol=1e-15)


def test_orthonormal_rows_are_that_and_of_full_rank() -> None:
    _, _, pair = torn_pair()
    E = pair.equalities
    B = np.diag(1 / pair.scale) @ pair.B.toarray()
    assert_allclose(B[:E] @ B[:E].T, np.eye(E), atol=1e-14)
    assert_allclose(B[E:] @ B[:E].T, 0, atol=1e-14)
    root_E = np.linalg.norm(pair.B.toarray(), axis=1)
    assert_allclose(np.unique(root_E.round(6)), np.sqrt([400.0, 4000.0]).round(6))


def test_a_kind_knows_its_boundary_and_what_it_is_made_of() -> None:
    _, _, pair = torn_pair(most=4)
    beam = pair.kinds[0]  # 4 × 4 cells
    assert beam.boundary.size == 2 * 16
    assert_allclose(beam.stiffness, 4000.0)  # E l/F₀
    assert np.unique(np.concatenate([k.stiffness for k in pair.kinds])).size == 2
