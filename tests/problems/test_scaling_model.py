"""Cost model of Total FETI on many cores."""

import itertools
import re
from bisect import bisect

import numpy as np
import pytest
from scipy import sparse
from sksparse.cholmod import cholesky

import mortarbench as mb
from mortarbench.problems.experiments.scaling_model import (
    PAPER,
    Distribution,
    factor_entries,
    predict,
)
from tests.support import ROOT

#: cores → √m times the time per product of a prototype in ms, for clusters of side
#: m = 1, 2, 4 and 8, as far as available
PROTOTYPE = {
    128: (15,), 1024: (18, 21), 10240: (92, 27, 29), 102400: (1835, 168, 41.5, 41.1),
}  # fmt: skip
CELLS = [
    (cores, 2**k, t) for cores, row in PROTOTYPE.items() for k, t in enumerate(row)
]


def without_joints(one):
    return one.steps * (one.seconds - one.joints - one.rows)


@pytest.mark.parametrize(("cores", "m", "milliseconds"), CELLS)
def test_the_model_agrees_with_an_independent_prototype(cores, m, milliseconds):
    """The prototype omits the sparse rows and the joints of clusters."""
    one = predict(Distribution(cores=cores, cluster=m), PAPER)
    assert 1e3 * without_joints(one) == pytest.approx(milliseconds, rel=0.05)


def test_the_page_contains_the_predictions_of_the_code():
    page = (ROOT / "docs/scaling-model.md").read_text()
    rows = re.findall(r"^\| (\d+) \| (\d\.\d\de\+\d\d) \|(.*)\|$", page, re.MULTILINE)
    assert [int(row[0]) for row in rows] == list(PROTOTYPE)
    for cores, dofs, cells in rows:
        cells = [re.findall(r"[\d.]+", c) for c in cells.split("|") if c.strip()]
        settings = [
            Distribution(cores=int(cores), cluster=2**k) for k in range(len(cells))
        ]
        assert f"{settings[0].dofs:.2e}" == dofs
        for (whole, without, _), setting in zip(cells, settings, strict=True):
            one = predict(setting, PAPER)
            assert whole == f"{1e3 * one.effective:.1f}"
            assert without == f"{1e3 * without_joints(one):.1f}"


def test_the_entries_of_a_coarse_factor_follow_the_measured_law():
    """There are 8 × 8 × 8 subdomains, each coupled with all adjacent ones, of which
    there are at most 26, by 6 × 6 blocks."""
    S = 8
    line = sparse.diags_array(
        [np.ones(S - 1), np.ones(S), np.ones(S - 1)], offsets=[-1, 0, 1]
    )
    graph = sparse.kron(sparse.kron(line, line), line)
    G = sparse.csc_matrix(sparse.kron(graph, np.ones((6, 6))))
    G += sparse.csc_matrix(1e3 * sparse.eye_array(6 * S**3))
    entries = cholesky(G, ordering_method="metis", mode="simplicial").L().nnz

    assert factor_entries(6 * S**3, 6) == pytest.approx(entries, rel=0.05)


def traffic(side, cells, grid):
    """Return the number of values that each rank sends, counted node by node.

    A node with c copies on k ranks causes 2(1 − 1/k)(c − 1) values per component and
    rank.
    """
    ends = [[side * rank // p for rank in range(p + 1)] for p in grid]
    sent = np.zeros(grid)
    nodes = range(side * cells + 1)
    for node in itertools.product(nodes, repeat=3):
        copies, ranks = 1, []
        for i, cut in zip(node, ends, strict=True):
            subdomains = {min(i // cells, side - 1), max((i - 1) // cells, 0)}
            copies *= len(subdomains)
            ranks.append({bisect(cut, s) - 1 for s in subdomains})
        touching = list(itertools.product(*ranks))
        for rank in touching:
            sent[rank] += 2 * (1 - 1 / len(touching)) * (copies - 1)
    return 3 * sent


@pytest.mark.parametrize("cores", [1, 2, 4, 8])
def test_the_data_sent_by_a_core_equal_a_count_over_all_nodes(cores):
    run = Distribution(cores=cores, per_core=64 / cores, cells=2)
    assert traffic(4, 2, run.grid) == pytest.approx(run.sent)


def test_an_inner_core_has_26_neighbours_and_sends_most():
    run = Distribution(cores=27, per_core=8, cells=2)
    assert (run.grid, run.neighbours) == ((3, 3, 3), 26)
    assert traffic(6, 2, run.grid).max() == pytest.approx(run.sent)


@pytest.mark.parametrize(
    ("cores", "counted"), [(1, (0, 0)), (2, (35.4e3, 49.8e3)), (4, (36.7e3, 52.5e3))]
)
def test_bytes_and_messages_agree_with_ranks(cores, counted):
    """The numbers were counted for cube-wall/n=32 with feti=8 and 4; supported nodes
    are not glued."""
    for (side, cells), value in zip([(4, 8), (8, 4)], counted, strict=True):
        run = Distribution(cores=cores, per_core=side**3 / cores, cells=cells)
        assert 8 * run.sent == pytest.approx(value, rel=0.02)
        assert run.neighbours == cores - 1


def test_the_entries_of_rows_are_those_of_the_case():
    """In contrast to the model, the case also has rows of supports and contact."""
    B = mb.build("cube-wall/n=8/feti=2/dual").qp.P.build().packed.B
    entries = Distribution(cores=1, per_core=64, cells=2).entries
    assert entries == pytest.approx(B.nnz, rel=0.1)


def test_clusters_add_joints_and_shrink_the_coarse_problem():
    one, two = (Distribution(cores=8, per_core=64, cluster=m) for m in (1, 2))
    assert one.coarse == 8 * two.coarse
    assert predict(one, PAPER).joints == 0 < predict(two, PAPER).joints


def test_one_core_sends_nothing_and_congruent_subdomains_share_a_block():
    alone = predict(Distribution(cores=1, congruent=True), PAPER)
    different = predict(Distribution(cores=1), PAPER)
    assert (alone.sent, alone.messages, alone.reductions) == (0.0, 0.0, 0.0)
    assert different.blocks == pytest.approx(8 * alone.blocks)


def test_a_block_contains_the_surface_of_a_subdomain():
    assert Distribution(cores=1, cells=2).block == 3 * 26  # one of 27 nodes is inside
