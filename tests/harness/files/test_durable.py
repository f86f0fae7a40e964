"""Files on full disks, files of killed writers, and files changed by other programs.

The context manager `full` imitates a full disk by a file size limit. As on a full disk,
the kernel first writes fewer bytes than requested, then raises an error.
"""

import errno
import os
import resource
import signal
from contextlib import contextmanager
from functools import partial

import pytest

from mortarbench.cli.main import main
from mortarbench.harness import InputError
from mortarbench.harness.errors import FaultError
from mortarbench.harness.files.durable import (
    refuse_full_disk,
    remove_unfinished,
    replace_file,
    report_full_disk,
)
from mortarbench.harness.processes import measurement as remote
from mortarbench.registries import Registries
from tests.support import WRITE_REPORT, no_report
from tests.support.toy_registries import toy_registries


@contextmanager
def full(size=0):
    """Limit the size of all files to `size` bytes within the block."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_a_file_is_replaced_whole_and_has_the_usual_permissions(tmp_path):
    path = tmp_path / "new" / "file"
    for content in (b"old", b"newer"):
        replace_file(path, content)
        assert path.read_bytes() == content
    os.umask(umask := os.umask(0))

    assert path.stat().st_mode & 0o777 == 0o666 & ~umask
    assert [p.name for p in path.parent.iterdir()] == ["file"]


def test_on_a_full_disk_the_old_file_remains_without_temporary_files(tmp_path):
    path = tmp_path / "file"
    replace_file(path, b"old")
    with full(100), pytest.raises(OSError, match="File too large"):
        replace_file(path, bytes(1000))

    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_a_file_that_cannot_be_synced_replaces_nothing(tmp_path, monkeypatch):
    path = tmp_path / "file"
    replace_file(path, b"old")

    def fails(fd):
        raise OSError(errno.ENOSPC, "full")

    monkeypatch.setattr(os, "fsync", fails)
    with pytest.raises(OSError, match="full"):
        replace_file(path, b"new")

    assert path.read_bytes() == b"old"


def test_the_message_on_a_full_disk_names_the_disk_and_the_remedy(tmp_path):
    said = "free some space; the same command continues the run"
    for code in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        with pytest.raises(InputError) as e, report_full_disk(tmp_path / "none"):
            raise OSError(code, os.strerror(code))
        message = str(e.value)
        assert message.startswith(f"{tmp_path / 'none'} cannot be written: ")
        assert message.endswith(said)
        assert os.strerror(code) in message
    with pytest.raises(OSError, match="else"), report_full_disk(tmp_path):
        raise OSError(errno.EIO, "else")


def test_a_failure_is_attributed_to_the_disk_if_it_is_full(tmp_path):
    refuse_full_disk(tmp_path, "something else")
    with pytest.raises(InputError, match="No space left on device"):
        refuse_full_disk(tmp_path, f"exit code 1: {os.strerror(errno.ENOSPC)}: 'x'")
    with full(100), pytest.raises(InputError, match="File too large"):
        refuse_full_disk(tmp_path, "something else")
    refuse_full_disk(tmp_path / "no such folder", "something else")

    assert list(tmp_path.iterdir()) == []


def test_only_unfinished_files_of_writers_are_removed(tmp_path):
    own = [tmp_path / name for name in ("vectors", "report/tables", "none")]
    for folder in own[:2]:
        folder.mkdir(parents=True)
    ours = [
        ".mortarbench-0123.tmp", "report/tables/.mortarbench-4567.tmp",
    ]  # fmt: skip
    others = ["notes.tmp", "vectors/k.npz", "report/tables/a.tex"]
    for name in (*ours, *others):
        (tmp_path / name).touch()
    remove_unfinished(tmp_path, [own[0], tmp_path / "report", own[2]])

    files = (p for p in tmp_path.rglob("*") if p.is_file())
    assert sorted(str(p.relative_to(tmp_path)) for p in files) == sorted(others)


SUITE = """
name = "toy_problem"
repeats = 2
solvers = ["exact", "near"]
[[problems]]
family = "well"
forms = ["dual"]
"""


@pytest.fixture
def cli(command, monkeypatch, tmp_path):
    """Return a function that runs a command line on the toy problem in a folder that
    contains only a suite.
    """
    monkeypatch.setattr(WRITE_REPORT, no_report)
    (tmp_path / "toy.toml").write_text(SUITE)
    return partial(command, registries=toy_registries())


def test_a_run_states_measurements_prevented_by_faults(cli, monkeypatch, tmp_path):
    def measured(worker, qp, record, **request):
        if record.solver == "near":
            raise FaultError("the worker could not be started")
        return remote.measure_and_judge(worker, qp, record, **request)

    monkeypatch.setattr(
        "mortarbench.harness.running.executor.measure_and_judge", measured
    )
    code, out, err = cli("run", "toy.toml", "--out", "d")

    assert code == 1
    assert "2 measurements failed for reasons other than the solver: near on" in out
    assert "the worker could not be started; the same command tries again\n" in out
    assert err.count("it was not measured") == 2

    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    code, out, _ = cli("run", "toy.toml", "--out", "d")
    assert code == 0
    assert "failed for reasons other than the solver" not in out


def test_a_terminated_run_exits_with_143_and_restores_the_handler(cli, monkeypatch):
    before = signal.getsignal(signal.SIGTERM)

    def measured(*_, **__):
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(
        "mortarbench.harness.running.executor.measure_and_judge", measured
    )
    with pytest.raises(SystemExit) as e:
        cli("run", "toy.toml", "--out", "d")

    assert e.value.code == 143
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.parametrize("suffix", [".npz", ".mat", ".parquet", ".qps"])
@pytest.mark.parametrize("before", [None, b"of an earlier export"])
def test_a_terminated_export_leaves_no_partial_file(
    monkeypatch, tmp_path, suffix, before
):
    """The signal arrives when all bytes are written, but the file is not
    yet renamed.
    """
    path, sync, part = tmp_path / f"qp{suffix}", os.fsync, []
    if before is not None:
        path.write_bytes(before)

    def end(fd):
        sync(fd)
        part.extend(p.stat().st_size for p in tmp_path.iterdir() if p != path)
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(os, "fsync", end)
    with pytest.raises(SystemExit) as e:
        main(Registries(), ["export", "obstacle/dim=1/n=4/primal", str(path)])

    assert e.value.code == 143
    (size,) = part
    assert size > 0
    if before is None:
        assert not list(tmp_path.iterdir())
    else:
        assert list(tmp_path.iterdir()) == [path]
        assert path.read_bytes() == before
