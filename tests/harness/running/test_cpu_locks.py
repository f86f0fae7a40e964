"""CPU locks of the Dask workers of one user on one machine."""

import os
import subprocess
import sys
import tempfile
from importlib.util import find_spec

import pytest

from mortarbench.harness import InputError
from tests.support import ROOT

if find_spec("distributed") is None:
    pytest.skip("no distributed", allow_module_level=True)

CLAIM = """
from mortarbench.harness.running.dask_worker import claim_cpu
print(claim_cpu(), flush=True)
input()
"""


@pytest.fixture
def claim_cpu(tmp_path, monkeypatch):
    """Return the function for this process, with locks in a folder of the test."""
    from mortarbench.harness.running import dask_worker

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    dask_worker.claim_cpu.cache_clear()
    yield dask_worker.claim_cpu
    dask_worker.claim_cpu.cache_clear()


def test_workers_on_one_machine_use_different_cpus_while_available(claim_cpu, tmp_path):
    """The lock of a process ends with the process."""
    usable = os.sched_getaffinity(0)
    others = [
        subprocess.Popen(
            [sys.executable, "-c", CLAIM], stdin=subprocess.PIPE, text=True,
            stdout=subprocess.PIPE, cwd=tmp_path,
            env=os.environ | {"TMPDIR": str(tmp_path), "PYTHONPATH": str(ROOT)},
        )
        for _ in usable
    ]  # fmt: skip
    assert {int(other.stdout.readline()) for other in others} == usable
    with pytest.raises(InputError, match="start fewer"):
        claim_cpu()
    others[0].communicate("\n")
    assert claim_cpu() == claim_cpu()
    for other in others[1:]:
        other.communicate("\n")


def test_a_lock_that_is_a_link_is_not_followed(claim_cpu, tmp_path):
    victim = tmp_path / "victim"
    for cpu in os.sched_getaffinity(0):
        lock = tmp_path / f"mortarbench-{os.getuid()}-cpu{cpu}.lock"
        lock.symlink_to(victim)

    with pytest.raises(InputError, match="start fewer"):
        claim_cpu()
    assert not victim.exists()
