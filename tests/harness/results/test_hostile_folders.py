"""Result folders from others execute no code and give no access to other files."""

import os

import numpy as np
import pytest

from mortarbench.harness import InputError, Record, Verdict
from mortarbench.harness.files.store import (
    load_fields,
    load_solution,
    save,
)
from mortarbench.harness.results.journal import Journal
from tests.harness.files.test_hostile_files import hostile

SUITE = 'name = "s"\nsolvers = ["clarabel"]\n[[problems]]\nfamily = "file"\n'
FIELDS = {
    "points": np.zeros((4, 2)), "cells": np.array([[0, 1, 2, 3]]),
    "bodies": np.zeros(1, dtype=int), "displacement": np.zeros((4, 2)),
}  # fmt: skip


def record(path, **changes):
    """Return a verified measurement of a QP from a file."""
    given = dict(
        run_id="a1", case=f"file:{path}", family="file", params={"path": str(path)},
        form="qp", sizes={"variables": 2}, solver="clarabel", method="clarabel",
        options={}, tol=1e-6,
        repeat=0, block=0, status=Verdict.VERIFIED, claimed="solved", primal=0.0,
        dual=0.0, gap=0.0, complementarity=0.0, total_seconds=1e-3, environment="e1",
    )  # fmt: skip
    return Record(**given | changes)


@pytest.fixture
def sent(tmp_path):
    """Write a result folder with given records."""

    def write(*records):
        folder = tmp_path / "sent"
        folder.mkdir()
        with Journal(folder, "e1") as journal:
            for each in records:
                journal.append(each)
        (folder / "suite.toml").write_text(f'{SUITE}params = {{ path = ["a.npz"] }}\n')
        (folder / "environment.json").write_text('{"digest": "e1"}')
        return folder

    return write


def everything(folder):
    """Return the paths in a folder with the contents of files; links to folders are not
    followed.
    """
    return {
        path.relative_to(folder): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }


def one_line(err):
    return len([line for line in err.splitlines() if line.startswith("mortar")]) == 1


# execution of code


def test_no_command_runs_code_named_by_a_case_of_the_folder(sent, command, tmp_path):
    path = tmp_path / "a.npz"
    hostile(path, "subprocess:call")
    vectors = {"x": np.zeros(2), "y": np.zeros(0), "z": np.zeros(0)}
    folder = sent(record(path))
    point = save(folder, vectors | {"z_box": np.zeros(2)})
    with Journal(folder, "e1") as journal:
        journal.append(record(path, run_id="b2", vectors=point))
    environment = '{"digest": "e1", "plugins": {"evil.py": "0"}}'
    (folder / "environment.json").write_text(environment)
    (tmp_path / "evil.py").write_text(f"open({str(tmp_path / 'SENTINEL')!r}, 'w')")
    (tmp_path / "evil.py").rename(folder / "evil.py")

    assert command("report", folder, "--format", "md")[0] == 0
    code, out, err = command("validate", folder)
    assert code in (0, 1, 2), err
    assert "not an npz file" in out + err
    code, out, err = command("replay", folder, "b2")
    assert (code, out) == (2, "")
    assert "not an npz file" in err

    assert not (tmp_path / "SENTINEL").exists()


# paths that lead out of the folder


@pytest.mark.parametrize(
    "digest",
    ["../../outside", "/etc/passwd", "a\0b", "", "A" * 16, "\ud800", "x" * 5000],
)
def test_malformed_digests_open_no_file(tmp_path, digest):
    folder = tmp_path / "a" / "b"
    save(folder, FIELDS)
    np.savez(tmp_path / "outside.npz", **FIELDS)

    for load in (load_fields, lambda f, d: load_solution(f, d, "solved")):
        with pytest.raises(InputError, match="is not a digest"):
            load(folder, digest)


def test_commands_read_nothing_outside_the_folder_for_malformed_digests(
    sent, command, tmp_path
):
    np.savez(tmp_path / "outside.npz", **FIELDS)
    out = "../../outside"
    folder = sent(record("a.npz", vectors=out, fields=out, environment=out))

    code, _, err = command("report", folder, "--format", "md")
    assert (code, err) == (0, "")
    assert "is not a digest" in (folder / "report" / "report.md").read_text()
    for arguments in (("validate", folder), ("replay", folder, "a1")):
        code, _, err = command(*arguments)
        assert code == 2
        assert one_line(err.splitlines()[-1] + "\n")  # after progress


# links and pipes


LINKS = (
    "journal", "vectors", "environments", "report", ".scratch",
    "environment.json", "suite.toml", "validation.json", "validation.tmp",
    ".mortarbench.lock",
    "report/index.html", "report/report.md", "report/figures",
    "report/tables/evil", "vectors/evil.npz",
)  # fmt: skip


@pytest.mark.parametrize("name", LINKS)
def test_a_link_in_a_folder_is_refused_and_its_target_is_unchanged(
    sent, command, tmp_path, name
):
    folder = sent(record("a.npz"))
    outside = tmp_path / "outside"
    outside.mkdir()
    (outside / "precious").write_text("precious")
    link = folder / name
    link.parent.mkdir(parents=True, exist_ok=True)
    if link.is_dir():
        link.rename(tmp_path / "away")
    link.unlink(missing_ok=True)
    link.symlink_to(outside / "precious" if "." in name[1:] else outside)
    suite = tmp_path / "s.toml"
    suite.write_text(f'{SUITE}params = {{ path = ["a.qps"] }}\n')
    (tmp_path / "a.qps").write_text("ROWS\n N a\nENDATA\n")
    before = everything(outside)

    for arguments in (
        ("report", folder),
        ("validate", folder),
        ("replay", folder, "a1"),
        ("run", suite, "--out", folder, "--fresh"),
    ):
        code, _, err = command(*arguments)
        assert code == 2, arguments
        assert "is a link, pipe or device" in err or "no journal" in err
        assert one_line(err)
    assert everything(outside) == before
    assert link.is_symlink()


@pytest.mark.parametrize(
    "name", ["journal/e2.jsonl", "suite.toml", "environment.json", "report/index.html"]
)
def test_a_pipe_in_a_folder_is_refused_at_once(sent, command, name):
    folder = sent(record("a.npz"))
    pipe = folder / name
    pipe.parent.mkdir(exist_ok=True)
    pipe.unlink(missing_ok=True)
    os.mkfifo(pipe)

    for arguments in (
        ("report", folder),
        ("validate", folder),
        ("replay", folder, "a"),
    ):
        code, _, err = command(*arguments)
        assert code == 2
        assert f"{pipe} is a link, pipe or device" in err
