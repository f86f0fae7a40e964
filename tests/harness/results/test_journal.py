import os
import resource
import shutil

import pytest

from mortarbench.harness import InputError, Record, Verdict
from mortarbench.harness.results.journal import Journal, read_journal


def record(run_id, **changes):
    blank = Record(
        run_id=run_id, case="tiny/plain", family="tiny", params={"h": 1.0},
        form="plain", sizes={}, solver="a", options={}, tol=1e-6, repeat=0, block=0,
        status=Verdict.VERIFIED,
    )  # fmt: skip
    return blank.replace(**changes)


def ids(folder):
    return [r.run_id for r in read_journal(folder)]


def test_appended_records_are_read_back_in_order(tmp_path):
    first, second = record("a", gap=1e-9), record("b", status=Verdict.WRONG)
    with Journal(tmp_path, "here") as journal:
        journal.append(first)
        journal.append(second)

    assert read_journal(tmp_path) == [first, second]


def test_a_line_is_on_the_disk_when_append_returns(tmp_path, monkeypatch):
    file = tmp_path / "journal" / "here.jsonl"
    synced = []
    monkeypatch.setattr(os, "fsync", lambda fd: synced.append(file.read_bytes()))
    with Journal(tmp_path, "here") as journal:
        for run_id in "ab":
            journal.append(record(run_id))

            assert ids(tmp_path)[-1] == run_id
            assert synced[-1] == file.read_bytes()


def test_a_journal_cut_at_any_byte_loses_only_the_line_that_was_cut(tmp_path):
    with Journal(tmp_path, "here") as journal:
        journal.append(record("a"))
        journal.append(record("b"))
    file = tmp_path / "journal" / "here.jsonl"
    whole = file.read_bytes()
    first = whole.index(b"\n") + 1

    for size in range(first, len(whole)):
        file.write_bytes(whole[:size])
        assert ids(tmp_path) == ["a"]


@pytest.mark.parametrize("bad", [b'{"schema', b"", b"\xff"])
def test_the_message_on_a_damaged_line_contains_the_remedy(tmp_path, bad):
    file = tmp_path / "journal" / "here.jsonl"
    file.parent.mkdir()
    file.write_bytes(bad + b"\n")

    with pytest.raises(InputError, match=r"line 1: damaged .*; expected a JSON object"):
        read_journal(tmp_path)


def test_a_path_that_is_not_a_folder_is_reported_as_missing_or_a_file(tmp_path):
    (tmp_path / "file").touch()
    for name, wrong in (("nowhere", "no such folder"), ("file", "a file")):
        with pytest.raises(InputError) as e:
            read_journal(tmp_path / name)
        assert str(e.value) == f"{tmp_path / name}: {wrong}; expected a result folder"


@pytest.mark.parametrize("change", ["delete", "move", "replace", "shorten", "extend"])
def test_a_journal_that_another_program_changes_is_not_written(tmp_path, change):
    file = tmp_path / "journal" / "here.jsonl"
    with Journal(tmp_path, "here") as journal:
        journal.append(record("a"))
        os.link(file, file.with_name("backup"))  # does not change the file
        journal.append(record("b"))
        content = file.read_bytes()
        match change:
            case "delete":
                shutil.rmtree(file.parent)
            case "move":
                file.rename(tmp_path / "away")
            case "replace":
                file.unlink()
                file.write_bytes(content)
            case "shorten":
                os.truncate(file, 5)
            case "extend":
                file.write_bytes(content + b"more\n")
        with pytest.raises(InputError, match="was moved, deleted or changed"):
            journal.append(record("c"))

    with Journal(tmp_path, "here") as journal:
        if change != "extend":
            journal.append(record("d"))
    assert b"more" not in file.read_bytes() or change == "extend"


@pytest.mark.parametrize("tail", [b"x", b"x" * 2**16, b"x" * 200_000, b""])
def test_text_after_the_last_newline_is_removed_at_any_length(tmp_path, tail):
    file = tmp_path / "journal" / "here.jsonl"
    file.parent.mkdir()
    for head in (b"", b"one\n", b"one\n" + b"y" * 2**16 + b"\n"):
        file.write_bytes(head + tail)
        with Journal(tmp_path, "here"):
            assert file.read_bytes() == head


def test_a_partially_written_record_is_not_in_the_journal(tmp_path):
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    file = tmp_path / "journal" / "here.jsonl"
    with Journal(tmp_path, "here") as journal:
        journal.append(record("a"))
        limit = file.stat().st_size + 50  # only 50 bytes of the next line fit
        resource.setrlimit(resource.RLIMIT_FSIZE, (limit, before[1]))
        try:
            with pytest.raises(OSError, match="File too large"):
                journal.append(record("b"))
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, before)
        assert file.stat().st_size == limit - 50
        journal.append(record("c"))

    assert ids(tmp_path) == ["a", "c"]
