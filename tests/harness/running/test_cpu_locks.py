"""CPU locks in a folder that only the user of the Dask workers can access."""

import os
import tempfile
from contextlib import ExitStack

import pytest

from mortarbench.harness import InputError


def claim_cpu(stack):
    # imported here because it loads slowly
    from mortarbench.harness.running.dask_worker import claim_cpu

    return claim_cpu(stack)


@pytest.fixture
def shared(tmp_path, monkeypatch):
    """Set a folder of temporary files that is used only by this test."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    return tmp_path


def ours(shared):
    return shared / f"mortarbench-{os.getuid()}"


def test_workers_on_one_machine_use_different_cpus_while_available(shared):
    usable = os.sched_getaffinity(0)
    with ExitStack() as stack:
        assert {claim_cpu(stack) for _ in usable} == usable
        with pytest.raises(InputError, match="start fewer"):
            claim_cpu(stack)
    with ExitStack() as stack:
        assert claim_cpu(stack) in usable


def test_only_this_user_can_access_the_lock_folder(shared):
    with ExitStack() as stack:
        claim_cpu(stack)
    assert ours(shared).stat().st_mode & 0o777 == 0o700


def link_elsewhere(path, elsewhere):
    path.symlink_to(elsewhere)


def file_instead(path, elsewhere):
    path.write_text("")


def open_to_all(path, elsewhere):
    path.mkdir()
    path.chmod(0o777)


@pytest.mark.parametrize("plant", [link_elsewhere, file_instead, open_to_all])
def test_a_lock_folder_that_is_not_private_is_refused(shared, plant):
    elsewhere = shared / "elsewhere"
    elsewhere.mkdir(mode=0o700)
    plant(ours(shared), elsewhere)

    alone = "only this user can access"
    with ExitStack() as stack, pytest.raises(InputError, match=alone):
        claim_cpu(stack)
    assert not list(elsewhere.iterdir())


def test_a_lock_folder_of_another_user_is_refused(shared, monkeypatch):
    us = os.getuid()
    monkeypatch.setattr(os, "getuid", lambda: us + 1)
    ours(shared).mkdir(mode=0o700)  # owned by us, not by the other user

    alone = "only this user can access"
    with ExitStack() as stack, pytest.raises(InputError, match=alone):
        claim_cpu(stack)


def test_a_lock_that_is_a_link_is_not_followed(shared):
    ours(shared).mkdir(mode=0o700)
    victim = shared / "victim"
    for cpu in os.sched_getaffinity(0):
        (ours(shared) / f"cpu{cpu}.lock").symlink_to(victim)

    with ExitStack() as stack, pytest.raises(OSError, match="symbolic links"):
        claim_cpu(stack)
    assert not victim.exists()
