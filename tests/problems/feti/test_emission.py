"""Shares that ranks emit, each from the parameters of a case: the QP of one process."""

import json
import os
import subprocess
import sys

import pytest

from harness.distributed import mpi
from problems.ranges import emitted_on_ranks
from tests.support import ROOT, SUPPORT

CASES = (
    "beam-ring/Nr=4/Nh=3/steps=1/feti=4/dual",
    "beam-ring/Nr=5/Nh=3/steps=1/feti=3/glue=redundant/friction=tresca/bound=1e5/dual",
    "contact-patch/feti=3/slave=upper/ratio=5/glue=chain/dual",
    "membranes/S=2/n=3/dual",
    "plate/Sx=3/Sy=2/n=3/ny=2/pattern=checkerboard/jump=10/load=edge/dual",
)
ROUNDING = 1e-14


@pytest.fixture(
    scope="module",
    params=[2, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 4))],
)
def found(request):
    """What the shares of several ranks are together."""
    done = subprocess.run(
        [
            mpi.mpiexec(), "-n", str(request.param), sys.executable, "-m", "mpi4py",
            str(SUPPORT / "emitted_on_ranks.py"), *CASES,
        ],
        cwd=ROOT, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": "."},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("case", CASES)
def test_shares_are_the_qp_of_one_process_row_by_row(found, case):
    of = found[case]
    assert of["sizes"][0] == of["sizes"][1]
    assert of["entries"][0] == of["entries"][1]
    assert max(of["errors"].values()) < ROUNDING, of["errors"]
    assert max(of["bounds"]) < ROUNDING


@pytest.mark.parametrize("case", CASES)
def test_every_row_has_one_owner_and_every_torn_unknown_one_rank(found, case):
    of = found[case]
    assert set(of["owners"]) == {1}
    assert len(of["owners"]) == of["sizes"][1][0]
    assert of["torn"] == 0


@pytest.mark.parametrize(
    "changed", [{"steps": 2}, {"relin": 3}, {"friction": "coulomb"}, {"feti": 0}]
)
def test_what_needs_solutions_or_has_no_subdomains_is_emitted_by_one(changed):
    plain = {"feti": 4, "steps": 1, "relin": 1, "friction": "none"}

    assert emitted_on_ranks(plain)
    assert not emitted_on_ranks(plain | changed)
