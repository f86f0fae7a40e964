"""F = B K⁺Bᵀ by classes, and its preconditioners, compared with dense definitions."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import block_diag, null_space
from scipy.sparse import csr_array

from mortarbench.harness import QP, no_rows
from mortarbench.harness.files.qpfile import load_qp, save_qp
from mortarbench.harness.operators import Preconditioned
from mortarbench.problems import OPERATORS
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.duality.monolithic import primal_qp
from mortarbench.problems.families.beam_ring import model
from mortarbench.problems.families.feti_models import Membranes
from mortarbench.problems.feti.operator_arrays import (
    dual_operator,
    dual_operator_from_arrays,
)
from mortarbench.problems.feti.operators import (
    block_bytes,
    block_pseudoinverse,
    explicit_classes,
)
from mortarbench.problems.feti.served import Served
from mortarbench.problems.feti.subdomains import TornBodies
from mortarbench.problems.feti.tearing import blocks
from tests.support.decomposed_bodies import decompose_by_labels, labelled

pytestmark = pytest.mark.together

GLUING = ("orthonormal", "redundant")
SCALINGS = ("multiplicity", "stiffness")
KINDS = ("lumped", "dirichlet")


def beam_and_ring(rows="orthonormal"):
    bodies = model(2, 2, 4, "strain")
    primal = primal_qp(
        bodies, linearisation(bodies, "nts", "dual")(np.zeros(bodies.mesh.dofs))
    )
    beam = blocks((16, 2), 2)
    label = np.append(beam, beam.max() + 1 + blocks((24, 4), 4))
    return decompose_by_labels(bodies, labelled(bodies, label), primal, rows=rows)


def membranes(rows="orthonormal", size=2, cells=4):
    return Served(TornBodies(Membranes(S=size, n=cells, glue=rows).in_subdomains()))


@pytest.fixture(
    scope="module",
    params=[(tear, rows) for tear in (beam_and_ring, membranes) for rows in GLUING],
    ids=lambda p: f"{p[0].__name__}-{p[1]}",
)
def pair(request):
    tear, rows = request.param
    return tear(rows)


def operator_of(pair):
    return dual_operator(pair.operator)


def dense(pair):
    """Return K, B and R of all subdomains as dense matrices."""
    domains = pair.domains
    K = block_diag(*(domains.template(k).K.toarray() for k in domains.class_of))
    return K, pair.torn.rows.B.toarray(), pair.torn.kernel().toarray()


def test_the_kernel_is_orthonormal_and_has_no_energy(pair):
    K, _, R = dense(pair)

    assert_allclose(R.T @ R, np.eye(R.shape[1]), atol=1e-13)
    assert abs(K @ R).max() < 1e-13 * abs(K).max()


def test_the_inverse_of_torn_bodies_is_a_generalised_one_and_symmetric(pair):
    K, _, _ = dense(pair)
    inverse = pair.domains.inverse
    K_plus = np.stack([inverse(e) for e in np.eye(len(K))], axis=1)

    assert abs(K @ K_plus @ K - K).max() < 1e-12 * abs(K).max()
    assert_allclose(K_plus, K_plus.T, atol=1e-12 * abs(K_plus).max())


def test_products_are_those_of_any_generalised_inverse_on_balanced_loads(pair):
    K, B, R = dense(pair)
    F = operator_of(pair) @ np.eye(len(B))
    G = R.T @ B.T
    P = np.eye(len(B)) - np.linalg.pinv(G) @ G
    expected = P @ B @ np.linalg.pinv(K, rcond=1e-11) @ B.T @ P

    assert_allclose(P @ F @ P, expected, atol=1e-12 * abs(expected).max())
    assert_allclose(F, F.T, atol=1e-13 * abs(F).max())


def test_a_product_with_a_matrix_is_that_with_each_column(pair):
    F = operator_of(pair)
    x = np.random.default_rng(3).standard_normal((F.shape[0], 3))
    columns = np.stack([F @ column for column in x.T], axis=1)

    assert_allclose(F @ x, columns, rtol=1e-12, atol=1e-14)


def test_an_implicit_block_gives_the_same_product(pair):
    arrays = operator_of(pair).arrays
    implicit = dual_operator_from_arrays(
        {**arrays, "explicit": np.zeros_like(arrays["explicit"])}
    )
    x = np.random.default_rng(3).standard_normal((pair.torn.rows.c.size, 2))
    Fx = dual_operator_from_arrays(arrays)(x)

    assert arrays["explicit"].all()
    assert_allclose(implicit(x), Fx, atol=1e-11 * abs(Fx).max())
    assert_allclose(implicit(x[:, 0]), Fx[:, 0], atol=1e-11 * abs(Fx).max())
    for kind in KINDS:
        Mx = dual_operator_from_arrays(arrays).preconditioner(kind, "stiffness")(x)
        found = implicit.preconditioner(kind, "stiffness")(x)
        assert_allclose(found, Mx, atol=1e-9 * abs(Mx).max())


def test_the_diagonal_is_that_of_the_matrix(pair):
    P = operator_of(pair)
    implicit = dual_operator_from_arrays(
        {**P.arrays, "explicit": np.zeros_like(P.arrays["explicit"])}
    )
    diagonal = np.diag(P @ np.eye(P.shape[0]))

    assert_allclose(P.diagonal(), diagonal, rtol=1e-10)
    assert_allclose(implicit.diagonal(), diagonal, rtol=1e-10)


def test_the_largest_blocks_are_implicit_if_memory_is_limited(monkeypatch):
    pair = beam_and_ring()
    arrays, domains, B = operator_of(pair).arrays, pair.domains, pair.torn.rows.B
    sizes = [
        np.unique(np.concatenate([
            B[:, domains.start[s] : domains.start[s + 1]].indices
            for s in np.flatnonzero(domains.class_of == k)
        ])).size for k in range(domains.sizes.size)
    ]  # fmt: skip
    assert len(set(sizes)) > 1
    room = 16 * (np.square(sizes).sum() - 1) / 2**20
    monkeypatch.setattr("mortarbench.problems.feti.operators.MAX_EXPLICIT_MIB", room)

    explicit = explicit_classes(B, domains)

    assert arrays["explicit"].all()
    assert (np.array(sizes)[~explicit] == max(sizes)).all()
    assert (~explicit).sum() == 1


def test_blocks_stored_as_one_triangle_have_the_same_products():
    """Two membranes of one subdomain each form one class, or two classes; blocks of a
    class with one subdomain are stored as one triangle."""
    pair = membranes(size=1)
    F, of_both = operator_of(pair), pair.operator
    (size,), kind = pair.domains.sizes, pair.domains.template(0)
    two = replace(
        pair.domains, template=[kind, replace(kind)].__getitem__,
        sizes=np.array([size, size]), class_of=np.array([0, 1]),
    )  # fmt: skip
    explicit = explicit_classes(of_both.B, two)
    apart = dual_operator(replace(of_both, domains=two, explicit=explicit))
    x = np.random.default_rng(3).standard_normal((pair.torn.rows.c.size, 2))

    # two triangles of 6 doubles in each class, or two blocks of 9 doubles
    assert block_bytes(np.array([3, 3]), two).tolist() == [96, 96]
    assert block_bytes(np.array([3]), pair.domains).tolist() == [144]
    assert_allclose(apart @ x, F @ x, rtol=1e-11, atol=1e-13)
    for name in KINDS:
        M, of_two = (f.build().preconditioner(name, "stiffness") for f in (F, apart))
        assert_allclose(of_two(x), M(x), rtol=1e-11, atol=1e-12)
        assert_allclose(of_two(x[:, 1]), M(x)[:, 1], rtol=1e-11, atol=1e-12)


def definition(pair, kind, scaling):
    """Return B_D diag(D) B_Dᵀ by pseudoinverses; B_D is unique up to the kernel of
    Bᵀ."""
    _, B, _ = dense(pair)
    touched = np.abs(B).sum(axis=0) > 0
    D, softness = [], []
    domains = pair.domains
    for s, k in enumerate(domains.class_of):
        within = slice(domains.start[s], domains.start[s + 1])
        own, part = domains.template(k), touched[within]
        S = own.K.toarray().copy()
        edge = np.zeros(len(S), dtype=bool)
        edge[own.boundary] = True
        assert edge[part].all()
        if kind == "dirichlet":
            inner = np.linalg.inv(S[~edge][:, ~edge]) if (~edge).any() else 0
            S = S[edge][:, edge] - S[edge][:, ~edge] @ inner @ S[~edge][:, edge]
            part = part[edge]
        D.append(S[part][:, part])
        stiffness = own.stiffness[touched[within]]
        softness.append(1 / stiffness if scaling == "stiffness" else 0 * stiffness + 1)
    B, W = B[:, touched], np.diag(np.concatenate(softness))
    gram, E = B @ W @ B.T, pair.torn.rows.equalities
    gram[:E, E:] = gram[E:, :E] = 0  # drop couplings with contact
    B_D = np.linalg.pinv(gram, rcond=1e-10, hermitian=True) @ B @ W
    return B_D @ block_diag(*D) @ B_D.T


@pytest.mark.parametrize("scaling", SCALINGS)
@pytest.mark.parametrize("kind", KINDS)
def test_preconditioners_agree_with_their_dense_definition(pair, kind, scaling):
    M = operator_of(pair).build().preconditioner(kind, scaling)
    _, B, _ = dense(pair)
    expected = B.T @ definition(pair, kind, scaling) @ B

    MB = M(B)
    assert_allclose(B.T @ MB, expected, atol=3e-7 * abs(expected).max())
    assert_allclose(M(B[:, 0]), MB[:, 0], atol=1e-6 * abs(MB).max())


def test_preconditioners_add_nothing_in_the_kernel_of_redundant_rows():
    pair = membranes("redundant")
    _, B, _ = dense(pair)
    deaf = null_space(B.T)
    M = operator_of(pair).build().preconditioner("dirichlet", "stiffness")

    assert deaf.shape[1] == 2 * 3  # six rows for four copies have rank 3
    assert_allclose(deaf.T @ M(np.eye(len(B))), 0, atol=1e-13)


def test_small_blocks_are_pseudoinverted():
    rng = np.random.default_rng(8)
    of_rank_one = np.outer([1.0, -2.0, 3.0], [1.0, -2.0, 3.0])
    regular = np.diag([2.0, 3.0]) + 1
    M = block_diag(of_rank_one, [[5.0]], regular, 2 * of_rank_one, [[7.0]])
    turn = rng.permutation(len(M))
    M = M[turn][:, turn]

    found = block_pseudoinverse(csr_array(M)).toarray()
    assert_allclose(found, np.linalg.pinv(M), atol=1e-14)


@pytest.mark.parametrize("kind", KINDS)
def test_contact_rows_do_not_affect_the_weights_of_equality_rows(kind):
    """Contact touches supports at both feet of the ring."""
    pair = beam_and_ring()
    B, c, E = pair.torn.rows
    alone = dual_operator(replace(pair.operator, B=B[:E]))
    whole = operator_of(pair).build().preconditioner(kind, "stiffness")
    equations = alone.build().preconditioner(kind, "stiffness")(np.eye(E))

    assert (B[E:] @ B[:E].T).nnz
    found = whole(np.eye(c.size))[:E, :E]
    assert_allclose(found, equations, atol=1e-12 * abs(equations).max())


def test_preconditioners_reduce_the_condition_number():
    """The condition number is smallest with the Dirichlet preconditioner, and largest
    without a preconditioner."""
    pair = membranes(cells=8)
    F = operator_of(pair)
    _, B, R = dense(pair)
    G = R.T @ B.T
    P = np.eye(len(B)) - np.linalg.pinv(G) @ G
    PFP = P @ (F @ np.eye(len(B))) @ P

    def spread(M):
        values = np.linalg.eigvals(P @ M @ P @ PFP).real
        values = values[values > 1e-9 * values.max()]
        return values.max() / values.min()

    build = F.build().preconditioner
    lumped, dirichlet = (
        spread(build(k, "multiplicity")(np.eye(len(B)))) for k in KINDS
    )
    assert dirichlet < lumped < spread(np.eye(len(B)))


def test_a_wrong_name_of_a_preconditioner_is_refused_with_the_right_ones():
    built = operator_of(membranes()).build()

    assert isinstance(built, Preconditioned)
    with pytest.raises(ValueError, match="preconditioner 'ilu'; known: lumped, diri"):
        built.preconditioner("ilu", "stiffness")
    with pytest.raises(ValueError, match="scaling 'none'; known: multiplicity, stiff"):
        built.preconditioner("lumped", "none")


def test_a_written_operator_is_read_as_the_same(tmp_path):
    pair = beam_and_ring()
    F, c = operator_of(pair), pair.torn.rows.c
    m = c.size
    qp = QP(
        P=F, q=c, A=no_rows(m), b=np.zeros(0), G=no_rows(m), h=np.zeros(0),
        lb=np.full(m, -np.inf), ub=np.full(m, np.inf),
    )  # fmt: skip
    digest = save_qp(tmp_path / "qp.npz", qp, serialised=True)
    read, _ = load_qp(tmp_path / "qp.npz", operators=OPERATORS)
    x = np.random.default_rng(5).standard_normal(m)

    assert (read.P @ x == F @ x).all()
    assert save_qp(tmp_path / "again.npz", read, serialised=True) == digest


def test_equal_subdomains_share_one_stored_stiffness():
    few, many = (operator_of(membranes(size=S)).arrays for S in (1, 3))
    assert few["K_data"].size == many["K_data"].size
    assert many["kind"].size == 9 * few["kind"].size
