"""Clusters of subdomains joined by averages, compared with dense linear algebra."""

from dataclasses import replace
from functools import cache
from itertools import combinations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import block_diag, null_space

import mortarbench as mb
from mortarbench.harness import InputError, Status, no_rows
from mortarbench.harness.names import parse
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.harness.verify.verdicts import certified
from mortarbench.problems import PROBLEMS
from mortarbench.problems.duality.decomposed import decompose
from mortarbench.problems.feti.distributed import partition
from mortarbench.problems.feti.distributed_dual import LocalDual
from mortarbench.problems.feti.operators import DualOperator
from mortarbench.problems.feti.spectrum import spectra_over_ranks
from mortarbench.problems.feti.subdomains import Contact, on_one_process
from mortarbench.problems.models import plate
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe.solver import SMALBE
from tests.support.threads import on_threads, without_lock

pytestmark = pytest.mark.together

#: case, κ(PFP) of a prototype, and the number of rigid motions of all clusters
PUBLISHED = [
    ("plate", 10.7836, 48),
    ("plate/cluster=2", 20.8450, 12),
    ("plate/cluster=4", 35.8936, 3),
    ("plate/Sx=2/Sy=2/n=2/dim=3/Sz=2", 15.7460, 48),
    ("plate/Sx=2/Sy=2/n=2/cluster=2/dim=3/Sz=2", 21.7467, 6),
]


def params(name):
    return parse(f"{name}/dual", PROBLEMS).params


@cache
def built(name):
    return parse(f"{name}/dual", PROBLEMS).build(reference_solution)


def solved(name, tol=1e-8, **options):
    case = built(name)
    return case, replace(SOLVERS["smalbe"], **options).prepare(case.qp, tol)()


@pytest.mark.parametrize(
    ("name", "kappa", "motions"),
    [pytest.param(*row, marks=[pytest.mark.slow] * (row[0] != "plate/cluster=2"))
     for row in PUBLISHED],
)  # fmt: skip
def test_condition_numbers_are_those_of_a_prototype(name, kappa, motions):
    values = plate.dual_quantities(plate.model(tuple(params(name).items())))

    assert values["kappa"] == pytest.approx(kappa, rel=1e-5)
    assert values["coarse_unknowns"] == motions


def dense(local, side):
    """Return K, B and C as arrays; C is computed from the points of the faces."""
    domains, layout, d = local.domains, local.problem.layout, local.problem.components
    K = block_diag(*[domains.classes[k].K.toarray() for k in domains.class_of])
    nodes, points = local.nodes, np.concatenate([*layout.points(local.number)])
    place = np.column_stack([layout.body, layout.positions])
    rows = [np.zeros((0, len(K)))]
    for s, t in combinations(range(layout.count), 2):
        clusters = [(place[i, 0], *(place[i, 1:] // side)) for i in (s, t)]
        if clusters[0] != clusters[1] or abs(place[s] - place[t]).sum() != 1:
            continue
        a, b = (np.arange(*nodes.start[[i, i + 1]]) for i in (s, t))
        pairs = [(i, j) for i in a for j in b if nodes.number[i] == nodes.number[j]]
        i, j = np.array(pairs).T
        x = points[i] - points[i].mean(axis=0)
        modes = [np.eye(d)[k] + 0 * x[:, :d] for k in range(d)]
        for k, l in combinations(range(d), 2):
            spin = np.zeros((d, d))
            spin[k, l], spin[l, k] = -1.0, 1.0
            modes.append(x @ spin.T)
        for mode in modes:
            row = np.zeros((len(K) // d, d))
            turn = (
                local.rotation[nodes.subdomain] if d > 1 else np.ones((len(row), 1, 1))
            )
            row[i] = np.einsum("mkq,mk->mq", turn[i], mode)
            row[j] = -np.einsum("mkq,mk->mq", turn[j], mode)
            rows.append(row.reshape(1, -1))
    return K, local.rows.B.toarray(), np.concatenate(rows)


def eliminated(K, C):
    """Return K̃⁺ and a basis of ker K ∩ ker C, computed by restriction to ker C."""
    Z = null_space(C) if len(C) else np.eye(len(K))
    inside = Z.T @ K @ Z
    size, modes = np.linalg.eigh(inside)
    rigid = size < 1e-9 * size[-1]
    within = modes[:, ~rigid] / size[~rigid] @ modes[:, ~rigid].T
    return Z @ within @ Z.T, Z @ modes[:, rigid]


CASES = [
    ("plate/Sx=3/Sy=2/n=3/ny=2/cluster=2", 2),
    ("plate/Sx=4/Sy=2/n=2/pattern=checkerboard/jump=10/glue=chain/cluster=2", 2),
    ("plate/Sx=3/Sy=3/n=2/plane=stress/glue=redundant/cluster=3", 3),
    ("plate/Sx=4/Sy=2/n=1/cluster=2", 2),  # rows of C are linearly dependent
    ("plate/Sx=2/Sy=2/n=3/height=0.7/cluster=1", 1),
    ("plate/Sx=3/Sy=1/n=1/dim=3/Sz=2/cluster=2", 2),
]


@pytest.mark.parametrize(("name", "side"), CASES)
def test_the_spectrum_is_that_of_dense_elimination(name, side):
    p = params(name)
    local = on_one_process(plate.in_subdomains(p))
    K, B, C = dense(local, side)
    inverse, R = eliminated(K, C)
    F, P = B @ inverse @ B.T, null_space((B @ R).T)
    size = np.linalg.eigvalsh(P.T @ F @ P)
    size = size[size > 1e-9 * size[-1]]
    qp = LocalDual(local).share().qp
    (spectrum,) = spectra_over_ranks(qp.P, qp.A, tol=1e-7)

    assert qp.A.shape[0] == R.shape[1]
    assert spectrum.smallest == pytest.approx(size[0], rel=1e-6)
    assert spectrum.largest == pytest.approx(size[-1], rel=1e-6)
    # both bases of ker C ∩ ker K span the same space
    assert np.linalg.matrix_rank(np.hstack([R, local.units.kernel.toarray()])) == len(
        R.T
    )
    M = qp.P.preconditioner("dirichlet", "multiplicity")
    MF = np.linalg.eigvals(
        P @ P.T @ np.stack([np.asarray(M(P @ (P.T @ f))) for f in F.T], 1)
    )
    at = np.sort(MF.real[MF.real > 1e-9 * MF.real.max()])
    (spectrum,) = spectra_over_ranks(qp.P, qp.A, [("dirichlet", "multiplicity")], 1e-7)
    assert spectrum.condition == pytest.approx(at[-1] / at[0], rel=1e-6)


@pytest.mark.parametrize(
    ("name", "side"),
    [("plate/Sx=3/Sy=2/n=2/cluster=2", 2), ("plate/Sx=4/Sy=2/n=1/cluster=2", 2)],
)
def test_the_inverse_solves_the_constrained_problem(name, side):
    """For balanced loads, v = K̃⁺b satisfies Kv + Cᵀμ = b and Cv = 0; K̃⁺ is positive
    semidefinite."""
    local = on_one_process(plate.in_subdomains(params(name)))
    K, _, C = dense(local, side)
    known, R = eliminated(K, C)
    inverse = np.stack([local.units.inverse(e) for e in np.eye(len(K))], axis=1)
    scale = abs(inverse).max()
    off = inverse - known
    balanced = np.eye(len(K)) - R @ R.T

    assert abs(C @ inverse).max() <= 1e-10 * scale
    assert abs(balanced @ off @ balanced).max() <= 1e-10 * scale
    assert np.linalg.eigvalsh((inverse + inverse.T) / 2)[0] >= -1e-10 * scale
    assert abs(inverse - inverse.T).max() <= 1e-10 * scale


def test_subdomains_of_a_ring_are_joined_in_global_axes():
    """Congruent subdomains have different frames; a continuous displacement has no
    jumps."""
    problem = PROBLEMS["beam-ring"].contact_problem(params("beam-ring/Nr=2/Nh=2"))
    bodies, (stage, *_) = problem.bodies, problem.stages
    layout = bodies.shape.layout(2)
    none = Contact(no_rows(2 * layout.nodes), np.zeros(0), np.zeros(0))
    local = on_one_process(decompose(bodies, layout, "chain", stage, none, 2))
    v = local.spread @ np.sin(np.arange(2 * layout.nodes))
    jumps = local.clusters.averages @ v

    assert jumps.size > 0
    assert abs(jumps).max() <= 1e-12 * abs(v).max()
    assert local.unit_motions == local.clusters.motions.shape[1]
    assert abs(local.clusters.averages @ local.units.kernel).max() <= 1e-12


FAMILIES = [
    ("plate/Sx=3/Sy=2/n=3", "cluster=2"),
    ("membranes/S=4/n=2", "cluster=2"),
    ("obstacle/n=8/feti=2", "cluster=2"),
    ("beam-ring/Nr=3/Nh=2/steps=2/contact=mortar/feti=2", "glue=chain/cluster=2"),
    ("beam-ring/Nr=2/Nh=2/steps=1/friction=tresca/bound=1e6/feti=2", "cluster=2"),
    # with sides of one cell, averages determine the normal gluing rows
    ("contact-patch/lower=4/upper=6/feti=2", "cluster=2"),
    ("contact-patch/lower=4/upper=6/friction=coulomb/mu=0.3/feti=2", "cluster=2"),
    ("cube-wall/n=4/feti=2", "cluster=2"),
    ("cube-wall/n=3/feti=1", "glue=redundant/cluster=2"),
]


@pytest.mark.parametrize(("name", "cut"), FAMILIES)
def test_the_displacement_does_not_depend_on_clusters(name, cut):
    whole, s = solved(name)
    u, K = whole.mechanics.to_primal(s).x, whole.mechanics.primal.P
    case, s = solved(f"{name}/{cut}")
    error = case.mechanics.to_primal(s).x - u
    bound = certified(case, s)[0]["energy_bound"]

    assert s.status is Status.SOLVED
    assert kkt_residuals(case.qp, s).worst <= 1e-7
    assert abs(error).max() <= 1e-7 * abs(u).max()
    assert error @ (K @ error) <= 1e-14 * (u @ (K @ u))
    assert bound <= 1e-6


@pytest.mark.parametrize(
    ("name", "side"),
    [
        ("plate", 2), ("plate", 4),
        pytest.param("cube-wall/n=8/feti=2", 2, marks=pytest.mark.slow),
        ("beam-ring/Nr=8/Nh=4/steps=1/feti=4", 2),
        ("beam-ring/Nr=8/Nh=4/steps=1/feti=4", 4),
        *(pytest.param("greco/n=16/feti=4", side, marks=pytest.mark.slow)
          for side in (2, 4)),
    ],
)  # fmt: skip
def test_products_grow_at_most_like_the_root_of_the_side(name, side):
    """The condition number is about proportional to the side of a cluster."""
    alone, joined = (
        solved(one, 1e-6)[1].counts["P_products"]
        for one in (name, f"{name}/cluster={side}")
    )
    assert joined <= side**0.5 * alone


@pytest.mark.parametrize("preconditioner", ["auto", "lumped"])
def test_multipliers_whose_forces_act_on_averages_alone_do_not_drift(preconditioner):
    """F vanishes on these multipliers.

    Without Π, λ grew to 3e8 until all steps were used.
    """
    name = "contact-patch/lower=8/upper=12/feti=2/cluster=2"
    case, s = solved(name, preconditioner=preconditioner, max_steps=200)
    F = case.qp.P @ np.eye(case.qp.q.size)
    size, modes = np.linalg.eigh((F + F.T) / 2)
    free = modes[:, size < 1e-10 * size[-1]]

    assert s.status is Status.SOLVED
    assert free.shape[1] > 0
    assert np.linalg.norm(free.T @ s.x) <= 1e-7 * np.linalg.norm(s.x)


@pytest.mark.parametrize(
    "name",
    ["plate/Sx=4/Sy=2/n=2/cluster=2", "beam-ring/Nr=4/Nh=2/steps=1/feti=2/cluster=2"],
)
def test_ranks_contain_whole_clusters_and_have_the_same_operator(name, monkeypatch):
    without_lock(monkeypatch, DualOperator, "_blocks")
    qp, x = built(name).qp, np.sin(np.arange(built(name).qp.q.size))
    whole = qp.P.build()
    known = [whole(x), whole.diagonal(), whole.preconditioner("lumped", "stiffness")(x)]

    def work(ranks):
        P = whole.share(qp, ranks).qp.P
        own = P.halo.rows[P.halo.owned]
        mine = [
            P(x[own]),
            P.diagonal(),
            P.preconditioner("lumped", "stiffness")(x[own]),
        ]
        return (
            own,
            [np.asarray(v) for v in mine],
            P.local.clusters.domains.class_of.size,
        )

    shares = on_threads(2, work)
    for i, values in enumerate(known):
        got = np.empty_like(values)
        for own, mine, _ in shares:
            got[own] = mine[i]
        assert_allclose(got, values, atol=1e-9 * abs(values).max())
    assert sum(count for *_, count in shares) == whole.parts


def test_the_diagonal_is_that_of_the_operator():
    for name in ("membranes/S=4/n=2/cluster=2", "beam-ring/Nr=2/Nh=2/feti=2/cluster=4"):
        P = built(name).qp.P
        entries = np.diag(P @ np.eye(P.shape[0]))
        assert_allclose(P.diagonal(), entries, atol=1e-12 * entries.max())


def test_more_ranks_than_clusters_are_refused():
    qp = built("plate/Sx=2/Sy=2/n=2/cluster=2").qp
    with pytest.raises(InputError, match="2 ranks for 1 cluster; expected at most one"):
        partition(*(getattr(qp.P.build(), k) for k in ("B", "domains")), 2,
                  qp.P.build().clusters)  # fmt: skip


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("hertz-plane/n=2/feti=5/cluster=2", "do not form a grid; expected no cluster"),
        ("obstacle/dim=1/n=12/feti=4/cluster=2", "cluster=2 is not built"),
        ("hertz-plane/cluster=2", "cluster=2 is not used by feti=0, which leaves "),
        (
            "plate/cluster=2/supports=eliminated",
            "with supports=eliminated is not built",
        ),
        ("plate/cluster=-1", "cluster=-1 must be at least 0"),
        (
            "bodies:press.toml/parts=4/cluster=2",
            "unknown key 'cluster'; cluster and parts exclude each other, .*expected p",
        ),
        (
            "bodies:press.toml/feti=2",
            "unknown key 'feti'; feti and parts exclude each other, .*expected parts, ",
        ),
        (
            "greco/parts=4",
            "unknown key 'parts'; feti and parts exclude each other, .*expected feti, ",
        ),
    ],
)
def test_clusters_that_are_not_built_are_refused_by_name(name, message):
    with pytest.raises(InputError, match=message):
        built(name)


@pytest.mark.parametrize(
    "case",
    [
        "contact-patch/lower=6/upper=7/slave=lower/ratio=0.01/feti=1/cluster=2",
        "plate/dim=3/Sx=3/Sy=2/Sz=2/n=1/pattern=checkerboard/jump=100/cluster=2",
        "plate/Sx=3/Sy=2/n=1/pattern=checkerboard/jump=100/cluster=4/glue=chain",
        "hertz-sphere/n=2/feti=1/glue=redundant",
        pytest.param(
            "contact-patch/lower=12/upper=14/ratio=0.001/feti=2/cluster=2",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "contact-patch/lower=24/upper=28/ratio=0.001/feti=4/cluster=2",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "contact-patch/dim=3/lower=4/upper=4/ratio=0.001/feti=2/cluster=2",
            marks=pytest.mark.slow,
        ),
        pytest.param(
            "plate/dim=3/Sx=3/Sy=2/Sz=2/n=1/pattern=checkerboard/jump=1000/cluster=4",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_semidefinite_dual_ends_at_its_rounding_errors(case):
    """Directions in the kernel of F do not enlarge the multipliers.

    Without the rule for spent directions, these cases take 1000 products, and their
    dual residuals are between 1e-6 and 1.7.
    """
    qp = mb.build(f"{case}/dual").qp
    s = SMALBE().prepare(qp, 1e-8)()

    assert (s.status, s.message) == (Status.SOLVED, "converged")
    assert mb.verify(qp, s.x, s.y, s.z, s.z_box, tol=1e-8).residuals.worst <= 5e-8
    assert s.counts["P_products"] < 150
