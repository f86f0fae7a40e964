"""The message names the first rank that ended, whatever the ranks print."""

import json
import os
import subprocess
import sys

import pytest

from tests.support import ROOT, SUPPORT
from tests.support.dying_ranks import ENDINGS

#: program that keeps CPUs busy until its standard input is closed
BURNS = "import select, sys\nwhile not select.select([sys.stdin], [], [], 0)[0]: pass"


def wrong_names(tmp_path, count, trials, seed):
    """Return the trials in which a wrong rank was named; outputs of ranks are
    interleaved.
    """
    command = [sys.executable, str(SUPPORT / "dying_ranks.py")]
    with (tmp_path / "out").open("w+b") as out:
        subprocess.run(
            [*command, *map(str, (count, trials, seed))], stdout=out,
            stderr=subprocess.DEVNULL, env=os.environ | {"PYTHONPATH": str(ROOT)},
            check=True,
        )  # fmt: skip
        out.seek(max(0, out.seek(0, os.SEEK_END) - 2**16))
        return json.loads(out.read().splitlines()[-1])


def test_the_rank_that_ended_first_is_named_however_it_ended(tmp_path):
    assert wrong_names(tmp_path, 3, len(ENDINGS), seed=1) == []


@pytest.mark.slow
@pytest.mark.parametrize("burners", [0, 2])
def test_the_first_of_four_dying_ranks_is_named_in_a_hundred_trials(tmp_path, burners):
    command = [sys.executable, "-S", "-c", BURNS]
    busy = [subprocess.Popen(command, stdin=subprocess.PIPE) for _ in range(burners)]
    try:
        assert wrong_names(tmp_path, 4, 100, seed=2 + burners) == []
    finally:
        for process in busy:
            process.kill()
            process.communicate()
