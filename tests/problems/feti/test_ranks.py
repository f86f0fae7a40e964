"""Torn bodies on ranks in threads: rank 0 obtains the results of one process."""

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse import csr_array, issparse

from mortarbench.harness import Solution
from mortarbench.harness.distributed.comm import Team
from mortarbench.harness.mechanics import Real
from mortarbench.harness.names import parse
from mortarbench.problems import PROBLEMS
from mortarbench.problems.feti.served import Served, operator_of
from mortarbench.problems.feti.subdomain_classes import Assembly
from mortarbench.problems.feti.subdomains import Contact, TornBodies, subdomain_ranks
from mortarbench.solvers.reference.operators import reference_of_operator
from mortarbench.solvers.reference.solve import reference_solution
from tests.support.decomposed_bodies import parts_of as problem_of
from tests.support.threads_comm import on_rank_0, unlock

pytestmark = pytest.mark.together

PRECONDITIONERS = [
    (kind, scaling)
    for kind in ("lumped", "dirichlet")
    for scaling in ("multiplicity", "stiffness")
]
#: names of cases, and numbers of ranks: redundant rows, friction in discs, later load
#: steps with Coulomb's law, jumps of the modulus, contact at all inner nodes
CASES = [
    ("membranes/S=2/n=3/glue=redundant", 3),
    ("contact-patch/lower=4/upper=3/friction=tresca/bound=1e5/feti=2/dim=3", 2),
    ("beam-ring/Nr=1/Nh=1/steps=2/friction=coulomb/mu=0.3/feti=1", 3),
    ("plate/Sx=2/Sy=2/n=2/pattern=column/jump=10", 2),
    ("obstacle/n=6/feti=3", 2),
]


@pytest.fixture(scope="module", autouse=True)
def ranks_do_not_lock_one_another_out():
    with pytest.MonkeyPatch.context() as patch:
        unlock(patch)
        yield


def facts(name, team, s=None):
    """Return results of a case for given vectors, and for the answer `s`."""
    named = parse(f"{name}/dual", PROBLEMS)
    case = named.family.divided(named.form).build(team, reference_of_operator)
    if case.certifiable is not None:
        mechanics = case.certifiable(Solution.without_point(case.qp, "solved", ""))[0]
    else:
        mechanics = case.mechanics.subdomains()
    parts = mechanics.parts
    torn, qp, F = parts.torn, case.qp, case.qp.P.build()
    rng = np.random.default_rng(5)
    X, v = rng.standard_normal((qp.q.size, 2)), rng.standard_normal(torn.f.size)
    w = rng.standard_normal(parts.spread.shape[0])
    at = np.flatnonzero(parts.spread.T @ np.ones(w.size))[::3]
    found = {
        "operator": {"Fx": qp.P @ X[:, 0], "FX": qp.P @ X, "diagonal": F.diagonal()},
        "preconditioner": {
            f"{p}{k}": F.preconditioner(*p)(x)
            for p in PRECONDITIONERS
            for k, x in enumerate((X, X[:, 1]))
        },
        "inverse": {"K⁺": torn.apply("inverse", v)},
        "parts": {
            "product": parts.product(w),
            "precise": parts.product(w.astype(Real)),
            "squared_product": parts.squared_product(w),
            "solve": parts.solve(w),
            "weight": parts.weight,
            "diagonal": parts.diagonal(at),
            "kernel": parts.kernel,
        },
        "dual": {"q": qp.q, "G": qp.A, "b": qp.b},
        "digest": case.digest,
    }
    if s is None:
        s = reference_of_operator(qp)
    quantities = dict(case.quantities(s))
    F.forget()  # factors are computed again
    return found | {
        "s": s,
        "u": {"u": case.recover(s)},
        "again": {"Fx": qp.P @ X[:, 0]},
        "quantities": quantities,
    }


@cache
def alone(name):
    return facts(name, Team())


@pytest.fixture(scope="module", params=CASES, ids=lambda p: p[0].partition("/")[0])
def both(request):
    """Return results of several ranks, and those of one process."""
    name, size = request.param
    known = alone(name)
    return on_rank_0(size, lambda team: facts(name, team, known["s"])), known


def same(found, known, relative=1e-9, rounding=0.0):
    assert found.keys() == known.keys()
    for name, value in known.items():
        got = found[name]
        if isinstance(value, dict):
            same(got, value, relative, rounding)
        elif isinstance(value, str) or value is None:
            assert got == value, name
        else:
            value, got = (
                x.toarray() if issparse(x) else np.asarray(x) for x in (value, got)
            )
            assert got.dtype == value.dtype, name
            size = np.abs(value[np.isfinite(value)]).max(initial=0)
            bound = relative * size + rounding
            assert_allclose(got, value, rtol=0, atol=bound, err_msg=name)


@pytest.mark.parametrize(
    "what", ["operator", "preconditioner", "inverse", "parts", "dual", "u", "again"]
)
def test_results_of_ranks_are_those_of_one_process(both, what):
    found, known = both
    same(found[what], known[what])


def test_quantities_are_those_of_one_process(both):
    """They contain the largest stresses, forces, and condition numbers."""
    found, known = both
    same(found["quantities"], known["quantities"], 1e-6, 1e-13)


def test_the_digest_is_that_of_one_process(both):
    found, known = both
    assert len(found["digest"]) == 16
    assert found["digest"] == known["digest"]


@pytest.mark.parametrize("name", [CASES[0][0], CASES[3][0]])
def test_the_digest_is_that_of_the_case_without_ranks(name):
    case = parse(f"{name}/dual", PROBLEMS).build(reference_solution)
    assert case.digest == alone(name)["digest"]


@pytest.mark.parametrize(
    "name",
    [
        "beam-ring/steps=1/dual", "beam-ring/steps=1/feti=4/primal",
        "beam-ring/kinematics=finite/steps=1/dual", "plate/primal", "hertz-plane/dual",
    ],
)  # fmt: skip
def test_cases_without_subdomains_are_not_built_on_ranks(name):
    case = parse(name, PROBLEMS)
    assert case.family.divided(case.form) is None


@pytest.mark.parametrize("size", [2, 3])
@pytest.mark.parametrize(
    "name", ["membranes/S=2/n=3", "beam-ring/Nr=2/Nh=2/steps=1/feti=2"]
)
def test_ranks_assemble_only_classes_of_their_subdomains(name, size, monkeypatch):
    problem, assembled = problem_of(f"{name}/dual"), []
    assemble = Assembly.__call__

    def counted(self, k):
        assembled.append((id(self), k))
        return assemble(self, k)

    monkeypatch.setattr(Assembly, "__call__", counted)

    def work(team):
        served = Served(TornBodies(problem, team))
        F = operator_of(served)
        F @ np.ones(F.shape[0])
        torn = served.torn
        return [set(torn.domains.class_of[torn.rank == r]) for r in range(size)]

    own = on_rank_0(size, work)

    by_rank = {rank: set() for rank, _ in assembled}
    for rank, k in assembled:
        by_rank[rank].add(k)
    assert sorted(by_rank.values(), key=sorted) == sorted(own, key=sorted)


def test_implicit_blocks_on_ranks_are_those_of_one_process(monkeypatch):
    monkeypatch.setattr("mortarbench.problems.feti.operators.MAX_EXPLICIT_MIB", 0)
    problem = problem_of("beam-ring/Nr=2/Nh=2/steps=1/feti=2/dual")

    def work(team):
        served = Served(TornBodies(problem, team))
        P, m = operator_of(served), served.torn.rows.c.size
        x = np.random.default_rng(6).standard_normal(m)
        F = P.build()
        M = F.preconditioner("dirichlet", "stiffness")
        assert not served.explicit.any()
        return {"Fx": P @ x, "diagonal": F.diagonal(), "Mx": M(x)}

    same(on_rank_0(2, work), work(Team()))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_no_choice_of_keys_is_another_case_on_ranks(seed):
    rng = np.random.default_rng(seed)
    for name in (*generated(rng), *generated(rng)):
        known = alone(name)

        def work(team, name=name, s=known["s"]):
            return facts(name, team, s)

        found = on_rank_0(2 + seed % 2, work)
        assert found["digest"] == known["digest"], name
        for what in ("operator", "preconditioner", "parts", "dual", "u", "again"):
            same(found[what], known[what], 1e-7)


def generated(rng):
    """Yield names of small cases with blocks of all shapes and at least three
    subdomains.

    Cylinders without Q are not included with Coulomb's law: supports fix the central
    node of both bodies, so that its friction force is not unique.
    """
    n = rng.integers(1, 8, size=8)
    glue = f"glue={rng.choice(['orthonormal', 'redundant'])}"
    method = f"{glue}/contact={rng.choice(['nts', 'mortar'])}"
    coulomb = f"/friction=coulomb/mu={rng.choice([0.05, 0.3, 0.6])}"
    law = rng.choice(["", "/friction=tresca/bound=1e5", coulomb])
    slave = f"slave={rng.choice(['upper', 'lower'])}"
    yield (
        f"beam-ring/Nr={n[0] % 3 + 1}/Nh={n[1] % 4 + 1}/radial={n[2]}/feti={n[3]}/"
        f"steps={n[4] % 2 + 1}/relin={n[5] % 2 + 1}/{method}{law}"
    )
    yield (
        f"contact-patch/lower={n[4] + 3}/upper={n[5] + 3}/feti={n[6] % 3 + 1}/{slave}/"
        f"{method}{law}"
    )
    yield (
        f"plate/Sx={n[0] % 3 + 1}/Sy={n[1] % 2 + 3}/n={n[2] % 4 + 1}/ny={n[3] % 4}/"
        f"pattern={rng.choice(['checkerboard', 'column'])}/jump=100/{glue}"
    )
    yield f"membranes/S={n[4] % 3 + 2}/n={n[5] % 4 + 1}/{glue}"
    yield (
        f"obstacle/n={n[4] + 6}/shape={rng.choice(['flat', 'hemisphere'])}/"
        f"feti={n[5] % 3 + 2}/{glue}"
    )
    yield f"hertz-plane/n={n[0] % 3 + 1}/feti={n[1] % 4 + 2}/{glue}"
    yield (
        f"hertz-cylinder/n=1/m={n[3] % 2 + 1}/feti={n[4] + 8}/{slave}/"
        f"Q={rng.choice([0.3, 0.7])}/{method}{coulomb}"
    )
    yield f"greco/n={n[7] + 4}/mu={rng.choice([0, 0.4, 1])}/feti={n[0] % 3 + 1}"


def subdomains(sizes, glued, fixed=0):
    """Return a problem with given numbers of nodes, and of fixed components of the
    first subdomain."""
    layout = SimpleNamespace(
        sizes=np.asarray(sizes), glued=lambda: np.asarray(glued), count=len(sizes),
        multiplicity=lambda node: np.ones(node.size), holder=lambda node: node // 10,
    )  # fmt: skip
    none = np.zeros(0)
    contact = Contact(csr_array((0, 1)), none, none)
    return SimpleNamespace(
        layout=layout, components=2, fixed=np.arange(fixed), contact=contact
    )


def test_equal_subdomains_are_cut_into_equal_halves():
    problem = subdomains([9] * 12, [5] * 12)
    assert subdomain_ranks(problem, 2).tolist() == [0] * 6 + [1] * 6
    assert subdomain_ranks(problem, 1).tolist() == [0] * 12


def test_nodes_of_supports_count_as_work_like_nodes_of_interfaces():
    problem = subdomains([20] * 4, [1] * 4, fixed=20)
    assert subdomain_ranks(problem, 2).tolist() == [0, 1, 1, 1]


def test_as_many_ranks_as_subdomains_have_one_subdomain_each():
    problem = subdomains([9, 9, 900, 9, 9], [5] * 5)
    assert subdomain_ranks(problem, 5).tolist() == list(range(5))


@pytest.mark.parametrize("ranks", [2, 3, 5])
def test_work_is_balanced_up_to_a_subdomain_and_no_rank_is_idle(ranks):
    rng = np.random.default_rng(ranks)
    for _ in range(100):
        sizes = rng.integers(1, 200, rng.integers(ranks, 60))
        glued = rng.integers(0, sizes + 1)
        rank = subdomain_ranks(subdomains(sizes, glued), ranks)
        work = glued**2 / max((glued**2).sum(), 1) + sizes / sizes.sum()
        load = np.bincount(rank, work, minlength=ranks)

        assert (np.diff(rank) >= 0).all()
        assert np.bincount(rank, minlength=ranks).min() >= 1
        assert load.max() <= work.sum() / ranks + work.max() + 1e-12
