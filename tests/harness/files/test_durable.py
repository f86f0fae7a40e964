"""Files on full disks, files of killed writers, and files changed by other programs.

The context manager `full` imitates a full disk by a file size limit. As on a full disk,
the kernel first writes fewer bytes than requested, then raises an error.
"""

import errno
import os
import resource
import signal
import sys
from contextlib import contextmanager

import pytest

from mortarbench.cli.main import main
from mortarbench.harness import InputError
from mortarbench.harness.errors import FaultError
from mortarbench.harness.files import durable
from mortarbench.harness.files.durable import (
    refuse_full_disk,
    remove_unfinished,
    replace_file,
    replacing,
    report_full_disk,
)
from mortarbench.harness.files.lines import Lines
from mortarbench.harness.processes import measurement as remote
from mortarbench.harness.registry import load_plugin
from mortarbench.harness.results.faults import (
    FAULTS,
    Fault,
    in_words,
    read_faults,
    remaining_faults,
)
from mortarbench.harness.results.folder import FolderLock, refuse_foreign
from mortarbench.registries import Registries
from mortarbench.reports.data.evidence import read_evidence
from mortarbench.reports.sections import Analysis
from mortarbench.reports.sections.summary import summary
from tests.support import TOY_PROBLEM


@contextmanager
def full(size=0):
    """Limit the size of all files to `size` bytes within the block."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.fixture
def lines(tmp_path):
    """Return a function that opens a file of lines; ``lines.told`` has its messages."""

    def lines():
        return Lines(tmp_path / "folder" / "lines", lines.told.append)

    lines.told = []
    lines.path = tmp_path / "folder" / "lines"
    return lines


def fault(run_id, **changes):
    told = {"time": "2026-01-01", "case": "c", "solver": "s", "what": "w"}
    return Fault(run_id=run_id, **({**told, "tried_again": False} | changes))


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


def test_a_block_that_raises_replaces_nothing(tmp_path):
    path = tmp_path / "file"
    replace_file(path, b"old")
    with pytest.raises(TypeError), replacing(path) as file:
        file.writelines([b"new", "not bytes"])

    assert path.read_bytes() == b"old"
    assert [p.name for p in tmp_path.iterdir()] == ["file"]


def test_a_partially_written_line_is_removed_at_once(lines):
    with lines() as file:
        file.append("a" * 50)
        with full(80), pytest.raises(OSError, match="File too large"):
            file.append("b" * 50)  # only 29 bytes fit
        assert lines.path.read_text() == "a" * 50 + "\n"
        file.append("c" * 50)

    assert lines.path.read_text().split() == ["a" * 50, "c" * 50]


def test_text_after_the_last_newline_is_removed_at_any_length(lines):
    lines.path.parent.mkdir()
    for tail in (b"x", b"x" * 2**16, b"x" * 200_000, b""):
        for head in (b"", b"one\n", b"one\n" + b"y" * 2**16 + b"\n"):
            lines.path.write_bytes(head + tail)
            with lines() as file:
                file.append("two")
            assert lines.path.read_bytes() == head + b"two\n"


@pytest.mark.parametrize("folder", [False, True])
def test_a_deleted_file_of_lines_is_restored_with_all_lines(lines, folder):
    with lines() as file:
        file.append("one")
        lines.path.unlink()
        if folder:
            lines.path.parent.rmdir()
        file.append("two")
        file.append("three")

    assert lines.path.read_text().split() == ["one", "two", "three"]
    (told,) = lines.told
    assert "deleted" in told


def test_a_replaced_file_keeps_its_lines_and_receives_missing_ones(lines):
    with lines() as file:
        file.append("one")
        file.append("two")
        replace_file(lines.path, b"other\ntwo\npart")
        file.append("three")

    assert lines.path.read_text().split() == ["other", "two", "one", "three"]


@pytest.mark.parametrize("change", [b"", b"one\nforeign\n", b"two\n", b"one "])
def test_a_file_written_by_another_program_is_refused_in_one_line(lines, change):
    changed = pytest.raises(InputError, match="changed by another program")
    with changed, lines() as file:
        file.append("one")
        with lines.path.open("r+b") as other:
            other.truncate()
            other.write(change)
        file.append("two")

    assert lines.path.read_bytes() == change


def test_a_line_edited_by_another_program_is_detected(lines):
    changed = pytest.raises(InputError, match="changed by another program")
    with changed, lines() as file:
        file.append("one")
        times = lines.path.stat()
        lines.path.write_text("two\n")
        os.utime(lines.path, ns=(times.st_atime_ns, times.st_mtime_ns))


def test_touching_or_linking_a_file_of_lines_does_not_stop_writing(lines):
    with lines() as file:
        file.append("one")
        lines.path.touch()
        file.append("two")
        os.link(lines.path, lines.path.with_name("backup"))
        file.append("three")

    assert lines.path.read_text().split() == ["one", "two", "three"]
    assert lines.told == []


def test_a_run_continues_from_lines_edited_before_its_start(lines):
    with lines() as file:
        file.append("one")
    lines.path.write_text("two\n")
    with lines() as file:
        file.append("three")

    assert lines.path.read_text().split() == ["two", "three"]


def test_the_message_on_a_full_disk_names_the_disk_and_the_remedy(tmp_path):
    said = "free some space; the same command continues the run"
    for code in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
        with pytest.raises(InputError) as e, report_full_disk(tmp_path / "none"):
            raise OSError(code, os.strerror(code))
        message = str(e.value)
        assert message.startswith(f"{tmp_path / 'none'} cannot be written: ")
        assert message.endswith(said)
        assert os.strerror(code) in message
        assert "MiB free" in message
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
    own = [tmp_path / name for name in ("vectors", "cases", "report/tables", "none")]
    for folder in own[:3]:
        folder.mkdir(parents=True)
    ours = [
        ".mortarbench-0123.tmp", "cases/k.new", "report/tables/.mortarbench-4567.tmp",
    ]  # fmt: skip
    others = ["notes.tmp", "cases/k.npz", "cases/k.lock", "report/tables/a.tex"]
    for name in (*ours, *others):
        (tmp_path / name).touch()
    remove_unfinished(tmp_path, [*own[:2], tmp_path / "report", own[3]])

    files = (p for p in tmp_path.rglob("*") if p.is_file())
    assert sorted(str(p.relative_to(tmp_path)) for p in files) == sorted(others)


def test_a_folder_stays_locked_if_its_lock_file_is_deleted(tmp_path):
    lock = FolderLock(tmp_path)
    (tmp_path / ".lock").unlink()

    assert lock.is_there()
    with pytest.raises(InputError, match="is being written by another run"):
        FolderLock(tmp_path)
    lock.close()
    FolderLock(tmp_path).close()


def test_a_folder_locked_by_another_run_after_deletion_of_the_lock_is_refused(tmp_path):
    lock = FolderLock(tmp_path)
    (tmp_path / ".lock").unlink()
    other = FolderLock(tmp_path)

    with pytest.raises(InputError, match="is being written by another run"):
        lock.is_there()
    assert other.is_there()
    lock.close()
    other.close()


def test_a_run_killed_at_its_start_leaves_a_recognised_folder(tmp_path):
    FolderLock(tmp_path).close()
    (tmp_path / "suite.toml").write_text("")  # environment.json is missing
    refuse_foreign(tmp_path)

    (tmp_path / ".lock").write_text("somebody else's")
    with pytest.raises(InputError, match="is not a result folder"):
        refuse_foreign(tmp_path)


def test_the_last_fault_of_each_missing_measurement_counts(tmp_path):
    every = [fault("a", what="x"), fault("b"), fault("a", what="y"), fault("c")]
    with Lines(tmp_path / FAULTS, print) as file:
        for one in every:
            file.append(one.to_json())
    with (tmp_path / FAULTS).open("a") as partial:
        partial.write('{"time')

    assert read_faults(tmp_path) == every
    assert remaining_faults(every, {"c"}) == [every[2], every[1]]
    assert in_words(remaining_faults(every, "abc")) == ""
    assert in_words(remaining_faults(every, "c")) == (
        "2 measurements failed for reasons other than the solver: y, w"
    )
    assert read_faults(tmp_path / "no such folder") == []


@pytest.mark.parametrize(
    "line", ["", "[]", "3", "{}", "[" * 10**5, '{"time": 1}', "\udcff", "null"]
)
def test_a_damaged_fault_is_named_with_its_line(tmp_path, line):
    content = fault("a").to_json() + "\n" + line + "\n"
    (tmp_path / FAULTS).write_bytes(content.encode(errors="surrogateescape"))

    with pytest.raises(InputError, match=r"faults\.jsonl, line 2: damaged; expected"):
        read_faults(tmp_path)


SUITE = """
name = "toy_problem"
repeats = 2
solvers = ["exact", "near"]
[[problems]]
family = "well"
forms = ["dual"]
"""


def first_page(folder, _formats, *, factor=10.0, pool_forms=False):
    """Write the sentences of the summary of a report."""
    (folder / "said").write_text(
        "\n".join(summary(Analysis(read_evidence(folder))).prose)
    )
    return []


@pytest.fixture
def cli(capsys, monkeypatch, tmp_path):
    """Return a function that runs a command line on the toy problem in a folder that
    contains only a suite; it returns the exit code, stdout and stderr.
    """
    monkeypatch.chdir(tmp_path)
    (tmp_path / "toy.toml").write_text(SUITE)
    plugin = load_plugin(TOY_PROBLEM)
    nothing = {"reference": None}
    registries = Registries(
        families=plugin.problems,
        solvers=plugin.solvers,
        report=first_page,
        start=(sys.executable, "-P", str(TOY_PROBLEM)),
        **nothing,
    )

    def cli(*argv):
        code = main(registries, argv)
        return code, *capsys.readouterr()

    return cli


def test_a_run_and_its_report_state_measurements_prevented_by_faults(
    cli, monkeypatch, tmp_path
):
    def measured(worker, qp, record, request, **limits):
        if record.solver == "near":
            raise FaultError("the worker could not be started")
        return remote.measure_and_judge(worker, qp, record, request, **limits)

    monkeypatch.setattr(
        "mortarbench.harness.running.executor.measure_and_judge", measured
    )
    code, out, err = cli("run", "toy.toml", "--out", "d")
    told = "2 measurements failed for reasons other than the solver: the worker could"

    assert code == 1
    assert f"{told} not be started; the same command tries again\n" in out
    assert err.count("it is tried again") == err.count("it was not measured") == 2
    assert told in (tmp_path / "d" / "said").read_text()

    monkeypatch.undo()
    monkeypatch.chdir(tmp_path)
    code, out, _ = cli("run", "toy.toml", "--out", "d")
    assert code == 0
    assert "failed for reasons other than the solver" not in out
    assert told not in (tmp_path / "d" / "said").read_text()


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
    path, sync, part = tmp_path / f"qp{suffix}", durable._sync, []
    if before is not None:
        path.write_bytes(before)

    def end(file):
        sync(file)
        part.extend(p.stat().st_size for p in tmp_path.iterdir() if p != path)
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(durable, "_sync", end)
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
