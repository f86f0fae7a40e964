"""Residuals and certificates by several ranks: what one process finds of the whole."""

import json
import os
import subprocess
import sys

import pytest

from harness.distributed import mpi
from tests.support import ROOT, SUPPORT

pytestmark = pytest.mark.together

HELD = (
    "beam-ring/Nr=4/Nh=3/steps=1/feti=4/dual",
    "beam-ring/Nr=5/Nh=3/steps=1/feti=3/glue=redundant/friction=tresca/bound=1e5/dual",
    "plate/Sx=4/Sy=2/n=4/dual",
    "obstacle/n=10/shape=hemisphere/feti=3/dual",
)
HELD_BY_CONTACT = "membranes/S=2/n=3/dual"
#: of a bound; K is the sum over subdomains on ranks, and the stored one elsewhere
ROUNDING = 1e-4


@pytest.fixture(
    scope="module",
    params=[2, *(pytest.param(n, marks=pytest.mark.slow) for n in (1, 4))],
)
def found(request):
    """What ranks, and one process, make of the same answers."""
    done = subprocess.run(
        [
            mpi.mpiexec(), "-n", str(request.param), sys.executable, "-m", "mpi4py",
            str(SUPPORT / "evaluated_on_ranks.py"), *HELD, HELD_BY_CONTACT,
        ],
        cwd=ROOT, capture_output=True, text=True, env=os.environ | {"PYTHONPATH": "."},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


@pytest.mark.parametrize("case", [*HELD, HELD_BY_CONTACT])
def test_residuals_by_ranks_are_those_of_one_process(found, case):
    for answer in found[case]:
        one = answer["by_one"]["values"]

        assert answer["by_ranks"]["values"] == pytest.approx(one, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize("case", HELD)
def test_certificates_by_ranks_are_those_of_one_process(found, case):
    for answer in found[case]:
        bounds, one = answer["by_ranks"]["bounds"], answer["by_one"]

        assert answer["same"]
        assert bounds["energy_bound"] == pytest.approx(one["bound"], rel=ROUNDING)
        assert bounds["certificate"] == pytest.approx(
            one["parts"], rel=ROUNDING, abs=1e-10
        )


def test_what_contact_alone_holds_is_certified_by_the_whole(found):
    for answer in found[HELD_BY_CONTACT]:
        assert answer["by_ranks"]["bounds"] == {}
        assert answer["by_ranks"]["note"] == ""
        assert answer["by_one"]["bound"] < 1
