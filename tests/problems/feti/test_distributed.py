"""Duals of torn bodies on ranks in threads; assignment of blocks to ranks."""

from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scipy.sparse import csr_array

from mortarbench.harness import QP, InputError, Solution, Status, no_rows
from mortarbench.problems.feti import distributed as over_ranks
from mortarbench.problems.feti.distributed import (
    BLOCK_SHARE,
    Assignment,
    Halo,
    assign_factorisations,
    assign_owners,
    balanced_partition,
    blocks_before_exchange,
    build_halo,
    local_share,
    partition,
)
from mortarbench.problems.feti.operator_arrays import dual_operator
from mortarbench.problems.feti.operators import DualOperator
from mortarbench.problems.feti.subdomains import on_one_process
from mortarbench.problems.models.membranes import Membranes
from tests.support.decomposed_bodies import decomposed_pair
from tests.support.threads import on_threads, without_lock


def loads(work):
    """Return the total work of each rank under `assign_factorisations`."""
    done = np.zeros(len(work))
    for name, task in assign_factorisations(work).items():
        size = work[task.factor_rank][name]
        done[task.factor_rank] += (1 - BLOCK_SHARE) * size
        done[task.block_rank] += BLOCK_SHARE * size
    return done


def test_two_ranks_share_an_odd_number_of_equal_classes_evenly():
    classes = dict.fromkeys("abcdefghi", 4)

    assert loads([classes, classes]).tolist() == [18, 18]
    factors = [
        task.factor_rank for task in assign_factorisations([classes, classes]).values()
    ]
    assert sorted(np.bincount(factors)) == [4, 5]


def test_blocks_fill_the_time_until_factors_are_sent():
    tasks = assign_factorisations([dict.fromkeys("abcdefghi", 4)] * 2)
    factors = np.bincount([task.factor_rank for task in tasks.values()])
    more, less = factors.argmax(), factors.argmin()

    assert blocks_before_exchange(tasks, more) == 0
    # a block takes a third of the time of a factor
    assert blocks_before_exchange(tasks, less) == 3


def test_classes_of_a_single_rank_are_factorised_before_the_exchange():
    tasks = {
        "a": Assignment(8, [0, 1], factor_rank=0, block_rank=1),  # the factor takes 6
        "b": Assignment(4, [1], factor_rank=1, block_rank=1),
        "c": Assignment(4, [1], factor_rank=1, block_rank=1),
        # not needed by other ranks
        "d": Assignment(40, [0], factor_rank=0, block_rank=0),
    }

    assert blocks_before_exchange(tasks, 1) == 1
    assert blocks_before_exchange(tasks, 0) == 0


def test_blocks_fill_the_time_until_the_last_factor_is_sent():
    tasks = {
        "a": Assignment(8, [0, 1], factor_rank=0, block_rank=1),  # the factor takes 6
        # the factor takes 12
        "e": Assignment(16, [1, 2], factor_rank=2, block_rank=1),
        **{name: Assignment(4, [1], factor_rank=1, block_rank=1) for name in "bcd"},
    }
    assert blocks_before_exchange(tasks, 1) == 3
    less = {name: task for name, task in tasks.items() if name != "e"}
    assert blocks_before_exchange(less, 1) == 1
    alone = {"a": less["a"], "b": Assignment(11, [1], factor_rank=1, block_rank=1)}
    assert blocks_before_exchange(alone, 1) == 1  # more than half of the block fits
    smaller = {n: t._replace(work=3) if n in "bcd" else t for n, t in less.items()}
    assert blocks_before_exchange(smaller, 1) == 2


def test_the_largest_classes_are_assigned_first():
    classes = {"a": 4, "b": 4, "c": 8}
    assert loads([classes, classes]).tolist() == [8, 8]


def test_only_ranks_with_a_subdomain_of_a_class_work_on_the_class():
    tasks = assign_factorisations([{"a": 8, "b": 8}, {"b": 8}, {"c": 40}])

    assert tasks["a"] == (8, [0], 0, 0)
    assert tasks["b"] == (8, [0, 1], 1, 1)
    assert tasks["c"] == (40, [2], 2, 2)
    assert [blocks_before_exchange(tasks, rank) for rank in range(3)] == [1, 1, 1]


def test_a_single_rank_factorises_all_classes():
    assert loads([{"a": 3, "b": 5}]).tolist() == [8]


def test_a_rank_never_receives_more_work_than_the_sender_keeps():
    rng = np.random.default_rng(7)
    for _ in range(200):
        names = rng.permutation(12)
        size = rng.integers(1, 50, 12)
        work = [
            {str(k): int(size[k]) for k in names[: rng.integers(1, 13)]}
            for _ in range(rng.integers(1, 5))
        ]
        tasks = assign_factorisations(work)
        whole = np.zeros(len(work))
        for name, task in tasks.items():
            assert {task.factor_rank, task.block_rank} <= set(task.ranks)
            whole[task.factor_rank] += work[task.factor_rank][name]
        assert set(tasks) == set().union(*work)
        assert loads(work).max() <= whole.max()


def test_contributions_of_several_neighbours_to_a_row_are_summed():
    """Row 0 is shared with both neighbours, rows 1 and 2 with one neighbour each."""
    arriving = np.array([1.0, 10.0, 100.0, 1000.0])
    at = Halo(
        ranks=SimpleNamespace(
            clocked=lambda name: nullcontext(),
            exchange=lambda *what: lambda: arriving,
        ),
        rows=np.arange(3), owned=np.arange(3), exported=np.array([0, 2, 0, 1]),
        ghosts=np.zeros(0, dtype=np.int64), export_counts=np.array([0, 2, 2]),
        ghost_counts=np.zeros(3, dtype=np.int64),
    )  # fmt: skip
    assert at.accumulate(np.array([0.5, 0.25, 0.125])).tolist() == [
        101.5,
        1000.25,
        10.125,
    ]


@pytest.fixture(autouse=True)
def ranks_do_not_lock_one_another_out(monkeypatch):
    without_lock(monkeypatch, DualOperator, "_blocks")


@pytest.fixture(
    scope="module",
    params=[
        lambda: on_one_process(Membranes(2, 3).in_subdomains("redundant")).decomposed,
        lambda: decomposed_pair("redundant", most=4)[2],
        lambda: decomposed_pair("orthonormal", most=4)[2],
    ],
    ids=["membranes", "redundant", "orthonormal"],
)
def torn(request):
    return request.param()


def dual_of(torn):
    """Return F, and a QP with this F whose data identify its rows."""
    F = dual_operator(torn.B, torn.domains, torn.equalities)
    m = torn.B.shape[0]
    G = csr_array((torn.B @ torn.domains.kernel).T)
    lower = np.where(np.arange(m) < torn.equalities, -np.inf, 0.0)
    return F.build(), QP(
        P=F, q=np.arange(m, dtype=float), A=G, b=np.arange(G.shape[0], dtype=float),
        G=no_rows(m), h=np.zeros(0), lb=lower, ub=1.0 + np.arange(m),
    )  # fmt: skip


PRECONDITIONERS = [
    (kind, scaling)
    for kind in ("lumped", "dirichlet")
    for scaling in ("multiplicity", "stiffness")
]


@pytest.mark.parametrize(
    "size", [1, 3, *(pytest.param(n, marks=pytest.mark.slow) for n in (2, 8))]
)
def test_shares_of_ranks_are_slices_of_the_whole(torn, size):
    F, qp = dual_of(torn)
    x = np.random.default_rng(4).standard_normal(qp.q.size)
    known = {"F": F(x), "diagonal": F.diagonal()}
    known |= {p: F.preconditioner(*p)(x) for p in PRECONDITIONERS}
    B = torn.B.toarray()
    known["onto rows"] = B @ np.linalg.lstsq(B, x, rcond=None)[0]

    def work(ranks):
        share = local_share(qp, F, ranks)
        part, P = share.qp, share.qp.P
        own = P.halo.rows[P.halo.owned]
        found = {"F": P(x[own]), "diagonal": P.diagonal()}
        assert (np.asarray(P @ x[own]) == found["F"]).all()
        found |= {p: P.preconditioner(*p)(x[own]) for p in PRECONDITIONERS}
        found["onto rows"] = P.onto_rows()(x[own])
        for name, value in known.items():
            got = np.asarray(found[name])
            assert_allclose(got, value[own], atol=1e-9 * np.abs(value).max())
        assert P.shape == (own.size, own.size)
        for got, whole in ((part.q, qp.q), (part.lb, qp.lb), (part.ub, qp.ub)):
            assert (np.asarray(got) == whole[own]).all()
        assert_allclose(part.A @ part.q, qp.A @ qp.q, atol=1e-9)
        assert (part.b == qp.b).all()
        solution = Solution(
            status=Status.SOLVED, x=x[own], y=part.b, z=np.zeros(0), z_box=2 * x[own]
        )
        return own, P.halo, share.whole(solution)

    found = on_threads(size, work)
    rows = np.concatenate([own for own, _, _ in found])
    assert (np.sort(rows) == np.arange(qp.q.size)).all()
    assert all(whole is None for _, _, whole in found[1:])
    whole = found[0][2]
    assert (whole.x == x).all()
    assert (whole.z_box == 2 * x).all()
    touching = np.bincount(np.concatenate([at.rows for _, at, _ in found]))
    for _, at, _ in found:
        assert (at.is_shared == (touching[at.rows] > 1)).all()
        assert (np.diff(at.rows) > 0).all()
        assert at.ghosts.size == at.rows.size - at.owned.size


def test_rows_are_owned_in_turn_by_the_ranks_that_touch_them():
    reach = csr_array(np.array([[1, 0, 1], [0, 1, 0], [1, 1, 1], [1, 1, 1], [1, 0, 1]]))
    rows = np.array([4, 5, 6, 7, 9])
    assert assign_owners(rows, reach).tolist() == [0, 1, 0, 1, 2]


def test_a_row_reaches_the_ranks_of_its_subdomains_and_one_of_them_owns_it(torn):
    B, domains = torn.B.toarray(), torn.domains
    parts = partition(torn.B, domains, 3)
    for row in range(len(B)):
        subdomains = [
            s for s in range(domains.class_of.size)
            if B[row, domains.start[s] : domains.start[s + 1]].any()
        ]  # fmt: skip
        ranks = sorted(set(parts.rank[subdomains].tolist()))
        touching = parts.reach[[row]]
        assert touching.indices.tolist() == ranks
        assert (touching.data == 1).all()
        assert parts.owner[row] == ranks[row % len(ranks)]


def test_subdomains_are_weighted_by_dense_blocks_and_connected_by_rows(
    torn, monkeypatch
):
    seen = {}

    def noted(graph, work, size, ranks):
        seen.update(graph=graph.toarray(), work=work, size=size)
        return np.arange(size.size) % ranks

    monkeypatch.setattr(over_ranks, "balanced_partition", noted)
    partition(torn.B, torn.domains, 2)
    B, start, kind = torn.B.toarray() != 0, torn.domains.start, torn.domains.class_of
    touches = np.add.reduceat(B, start[:-1], axis=1, dtype=int) > 0
    assert (seen["graph"] == touches.T.astype(int) @ touches).all()
    assert (seen["size"] == np.diff(start)).all()
    for s, k in enumerate(kind):
        same = np.flatnonzero(kind == k)
        block = np.any([B[:, start[t] : start[t + 1]].any(axis=0) for t in same], 0)
        assert seen["work"][s] == block.sum() ** 2


def chain(size):
    """Return the graph of subdomains in a row."""
    beside = np.eye(size, k=1, dtype=np.int32)
    return csr_array(beside + beside.T + 5 * np.eye(size, dtype=np.int32))


def test_subdomains_in_a_row_are_cut_into_equal_halves():
    ones = np.ones(12, dtype=np.int64)
    rank = balanced_partition(chain(12), 7 * ones, ones, 2)
    assert (np.diff(rank) != 0).sum() == 1
    assert np.bincount(rank).tolist() == [6, 6]


def test_a_single_rank_has_all_subdomains_without_a_call_of_metis(monkeypatch):
    monkeypatch.delattr(over_ranks, "_partitioned")
    ones = np.ones(5, dtype=np.int64)
    assert balanced_partition(chain(5), ones, ones, 1).tolist() == [0] * 5


def test_as_many_ranks_as_subdomains_have_one_subdomain_each():
    ones = np.ones(5, dtype=np.int64)
    assert sorted(balanced_partition(chain(5), ones, ones, 5).tolist()) == list(
        range(5)
    )
    with pytest.raises(InputError, match="6 ranks for 5 subdomains; expected at most"):
        balanced_partition(chain(5), ones, ones, 6)


#: ranks of eight subdomains of equal work; the first four are four times as large
ONLY_WORK = [0, 0, 0, 0, 1, 1, 1, 1]  #: work is balanced; sizes 16 and 4
ONLY_SIZE = [0, 0, 0, 1, 1, 1, 1, 1]  #: work 3 and 5, sizes 12 and 8
BETTER = [0, 0, 0, 1, 0, 1, 1, 1]  #: sizes of 13 and 7
BOTH = [0, 0, 1, 1, 0, 0, 1, 1]


@pytest.mark.parametrize(
    ("answers", "taken", "asked"),
    [
        ([BOTH], BOTH, 1),
        ([ONLY_WORK, ONLY_SIZE, BETTER, ONLY_WORK, BOTH], BOTH, 5),
        ([ONLY_WORK, ONLY_SIZE, BETTER], BETTER, 37),
        ([ONLY_WORK, BETTER, ONLY_SIZE], BETTER, 37),
        ([ONLY_WORK, BETTER, ONLY_WORK], BETTER, 37),
    ],
)
def test_among_partitions_with_balanced_work_the_best_sizes_are_chosen(
    answers, taken, asked, monkeypatch
):
    """If sizes are out of balance, METIS runs with 12 seeds and three weights of the
    size."""
    asks = []

    def answer(graph, weight, ranks, seed=None):
        assert not graph.diagonal().any()
        assert (graph.data > 0).all()  # METIS requires positive weights
        assert weight.dtype.kind == "i"
        assert weight.min() == 1
        asks.append((seed, weight.tolist()))
        return np.array(answers[min(len(asks), len(answers)) - 1])

    monkeypatch.setattr(over_ranks, "_partitioned", answer)
    work, size = np.full(8, 10), np.repeat([4, 1], 4)
    assert balanced_partition(chain(8), work, size, 2).tolist() == taken
    assert len(asks) == asked
    assert asks[0] == (None, [1] * 8)
    if asked == 37:
        assert len({seed for seed, _ in asks[1:]}) == 12


def test_weights_of_sizes_are_a_quarter_a_half_and_one(monkeypatch):
    """One subdomain has 7.94 times the mean size, and all others have 0.008 times the
    mean size; all have equal work.
    """
    seen = set()

    def answer(graph, weight, ranks, seed=None):
        seen.add(tuple(weight.tolist()))
        return np.array([0, 0, 0, 0, 1, 1, 1, 1])

    monkeypatch.setattr(over_ranks, "_partitioned", answer)
    size = np.array([1000, 1, 1, 1, 1, 1, 1, 1])
    balanced_partition(chain(8), np.full(8, 10), size, 2)
    assert seen == {(first, 1, 1, 1, 1, 1, 1, 1) for first in (1, 2, 4, 8)}


@pytest.mark.parametrize("unit", [1, 10])
def test_work_is_measured_in_units_of_the_smallest(unit, monkeypatch):
    weights = []

    def answer(graph, weight, ranks, seed=None):
        weights.append(weight.tolist())
        return np.array([0, 0, 1, 1])

    monkeypatch.setattr(over_ranks, "_partitioned", answer)
    balanced_partition(
        chain(4), unit * np.array([3, 1, 2, 2]), np.ones(4, dtype=np.int64), 2
    )
    assert weights == [[3, 1, 2, 2]]


def test_ranks_that_metis_leaves_idle_get_a_subdomain_of_the_largest(monkeypatch):
    import pymetis

    monkeypatch.setattr(
        pymetis, "part_graph", lambda *args, **how: (0, [0, 0, 2, 2, 2, 0, 2])
    )
    ones = np.ones(7, dtype=np.int64)
    found = balanced_partition(chain(7), ones, 10**6 * ones, 4)
    assert found.tolist() == [0, 0, 2, 2, 2, 3, 1]


def test_all_ranks_with_a_subdomain_of_a_class_receive_its_blocks(torn):
    F, qp = dual_of(torn)

    def work(ranks):
        local = local_share(qp, F, ranks).qp.P.local
        groups = local.packed.groups
        return dict(local.condense(groups)), groups

    for blocks, groups in on_threads(3, work):
        assert sorted(blocks) == list(range(len(groups)))
        for i, group in enumerate(groups):
            whole = group.template.condense(group.touched)
            for got, known in zip(blocks[i], whole, strict=True):
                assert_allclose(got, known, atol=1e-9 * np.abs(known).max())


def halo_of(ranks, here):
    """Return the halo of a rank, given a mask (ranks, m) of the rows that ranks
    touch."""
    rows = np.flatnonzero(here[ranks.rank])
    reach = csr_array(here[:, rows].T.astype(int))
    return build_halo(ranks, rows, reach, assign_owners(rows, reach))


def test_rows_are_coupled_if_the_sum_over_ranks_exceeds_rounding():
    """Two ranks share rows 0 … 5, and each rank touches two further rows alone."""
    here = np.zeros((2, 10), dtype=bool)
    here[:, :6] = here[0, [6, 8]] = here[1, [7, 9]] = True
    length = np.ones(10)
    length[[4, 6]], length[[5, 7]] = 1e3, 1e-3
    parts = np.array([np.diag(2.0 * on / here.sum(axis=0)) for on in here])
    for p, i, j, share in (
        (0, 0, 1, 0.5), (1, 0, 1, -0.5),  # these entries cancel
        (0, 2, 3, 0.25), (1, 2, 3, 0.25),
        (0, 4, 6, 1e-14), (1, 5, 7, 1e-14),  # rounding in long and short rows
        (0, 0, 8, 0.5),  # row 8 is not selected
        (1, 1, 9, 0.5),
    ):  # fmt: skip
        parts[p, i, j] = parts[p, j, i] = share
    parts *= np.outer(length, length)

    def work(ranks):
        at = halo_of(ranks, here)
        part = csr_array(parts[ranks.rank][np.ix_(at.rows, at.rows)])
        diagonal = at.accumulate(part.diagonal())
        return over_ranks._coupled(part, at, diagonal, at.rows != 8)

    assert set(np.concatenate(on_threads(2, work)).tolist()) == {1, 2, 3, 9}


def summed():
    """Return masks of 14 rows on three ranks, and summands."""
    rng = np.random.default_rng(0)
    here = np.zeros((3, 14), dtype=bool)
    for p in range(3):
        here[p, 4 * p : 4 * p + 6] = True
    parts = []
    for on in here:
        G = rng.standard_normal((14, 20)) * on[:, None]
        parts.append(G @ G.T)
    return here, parts


def test_the_sum_of_parts_on_selected_rows_is_inverted_on_all_ranks():
    """Couplings with unselected rows, and of equality with contact rows, are
    dropped."""
    here, parts = summed()
    some, first = np.array([0, 3, 4, 5, 8, 9, 12]), 5  # three equations
    A = sum(parts)[np.ix_(some, some)]
    A[:3, 3:] = A[3:, :3] = 0
    x = np.random.default_rng(1).standard_normal(14)
    known = np.full(14, np.nan)
    known[some] = np.linalg.solve(A, x[some])

    def work(ranks):
        at = halo_of(ranks, here)
        part = csr_array(parts[ranks.rank][np.ix_(at.rows, at.rows)])
        first_of = here[:, at.rows].argmax(axis=0) == ranks.rank  # on no other rank
        owned, inverse = over_ranks._replicated_inverse(
            part, np.isin(at.rows, some) & first_of, at, first
        )
        own = at.rows[at.owned]
        assert own[owned].tolist() == np.intersect1d(own, some).tolist()
        assert inverse(x[own[owned]]) == pytest.approx(known[own[owned]], rel=1e-5)
        return True

    assert all(on_threads(3, work))
