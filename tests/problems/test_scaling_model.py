"""Cost model of Total FETI on many cores."""

import re

import numpy as np
import pytest
from scipy import sparse
from sksparse.cholmod import cholesky

from mortarbench.problems.experiments.scaling_model import (
    PAPER,
    Distribution,
    factor_entries,
    predict,
)
from tests.support import ROOT

#: ms per product times √m of a prototype, by cores; m = 1, 2, 4, 8
PROTOTYPE = {
    128: (15,), 1024: (18, 21), 10240: (92, 27, 29), 102400: (1835, 168, 41.5, 41.1),
}  # fmt: skip
CELLS = [
    (cores, 2**k, t) for cores, row in PROTOTYPE.items() for k, t in enumerate(row)
]


@pytest.mark.parametrize(("cores", "m", "milliseconds"), CELLS)
def test_the_model_agrees_with_an_independent_prototype(cores, m, milliseconds):
    one = predict(Distribution(cores=cores, cluster=m), PAPER)
    assert 1e3 * one.effective == pytest.approx(milliseconds, rel=0.05)


def test_the_page_contains_the_predictions_of_the_code():
    page = (ROOT / "docs/scaling-model.md").read_text()
    rows = re.findall(r"^\| (\d+) \| (\d\.\d\de\+\d\d) \|(.*)\|$", page, re.MULTILINE)
    assert [int(row[0]) for row in rows] == list(PROTOTYPE)
    for cores, dofs, cells in rows:
        shown = [cell.split()[0] for cell in cells.split("|") if cell.strip()]
        settings = [
            Distribution(cores=int(cores), cluster=2**k) for k in range(len(shown))
        ]
        assert f"{settings[0].dofs:.2e}" == dofs
        effective = [1e3 * predict(s, PAPER).effective for s in settings]
        assert shown == [f"{t:.1f}" for t in effective]


def test_the_entries_of_a_coarse_factor_follow_the_measured_law():
    """8 × 8 × 8 subdomains, each coupled with its 26 neighbours by 6 × 6 blocks."""
    S = 8
    line = sparse.diags_array(
        [np.ones(S - 1), np.ones(S), np.ones(S - 1)], offsets=[-1, 0, 1]
    )
    graph = sparse.kron(sparse.kron(line, line), line)
    G = sparse.csc_matrix(sparse.kron(graph, np.ones((6, 6))))
    G += sparse.csc_matrix(1e3 * sparse.eye_array(6 * S**3))
    entries = cholesky(G, ordering_method="metis", mode="simplicial").L().nnz

    assert factor_entries(6 * S**3, 6) == pytest.approx(entries, rel=0.05)


def test_one_core_sends_nothing_and_congruent_subdomains_share_a_block():
    alone = predict(Distribution(cores=1, congruent=True), PAPER)
    different = predict(Distribution(cores=1), PAPER)
    assert (alone.sent, alone.messages, alone.reductions) == (0.0, 0.0, 0.0)
    assert different.blocks == pytest.approx(8 * alone.blocks)


def test_a_block_contains_the_surface_of_a_subdomain():
    assert (
        Distribution(cores=1, cells=2).block == 3 * 26
    )  # 27 nodes, one of them inside
