"""Commands on result folders in which one file was replaced."""

import os
import shutil
import subprocess
from contextlib import nullcontext, suppress
from fnmatch import fnmatch

import numpy as np
import pytest

import mortarbench as mb
from mortarbench.cli.main import main
from mortarbench.harness import InputError
from mortarbench.harness.results.folder import keep_environment
from mortarbench.harness.results.journal import read_journal
from mortarbench.registries import Registries
from tests.support.bounded import bounded

pytestmark = pytest.mark.together  # all tests use the same result folder

SUITE = """
name = "s"
repeats = 1
solvers = [{{ name = "smalbe", options = {{ history = true }} }}, "clarabel"]
[[problems]]
family = "contact-patch"
forms = ["dual"]
[[problems]]
family = "file"
params = {{ path = "{}" }}
"""
SPARSE = 3 * 2**30  #: size of a sparse file, which occupies no disk space


@pytest.fixture(scope="module")
def folder_of_run(tmp_path_factory, svg_only, blank):
    """Create a folder with files of every type, whose journal contains only the
    measurements by `smalbe`.
    """
    folder = tmp_path_factory.mktemp("whole") / "run"
    suite = folder.with_name("s.toml")
    np.savez(folder.with_name("qp.npz"), P=np.eye(2), q=-np.ones(2), lb=np.zeros(2))
    suite.write_text(SUITE.format(folder.with_name("qp.npz")))
    results = mb.run(suite, out=folder)
    mine = [r for r in results.records if r.solver == "smalbe"]
    (record,) = (r for r in mine if r.family == "contact-patch")
    keep_environment(folder, record.environment, {"machine": {}})
    with svg_only(), blank():
        mb.validate(folder)
        mb.report(folder)
    (journal,) = (folder / "journal").iterdir()
    journal.write_text("".join(f"{r.to_json()}\n" for r in mine))
    return folder


def kinds_of_files(folder):
    """Return one path for each folder and ending, and one path in the report."""
    paths = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            name = path.relative_to(folder)
            suffix = name.suffix if name.parts[0] != "report" else ""
            paths[name.parts[0], suffix] = name
    return [str(path) for path in paths.values()]


def with_zeros(path, _outside):
    """Append zeros to a file; its first lines stay valid."""
    with path.open("r+b") as file:
        file.truncate(SPARSE)


def below_the_limit(path, _outside):
    """Write a file below the limit of data files with a line above the
    limit of lines.
    """
    with path.open("r+b") as file:
        file.truncate(2**31 - 2**20)


def pipe(path, _outside):
    path.unlink()
    os.mkfifo(path)


def a_folder(path, _outside):
    path.unlink()
    path.mkdir()


def dangling(path, outside):
    path.unlink()
    path.symlink_to(outside / "nothing")


def foreign(path, outside):
    path.unlink()
    path.symlink_to(outside / "precious")


def endless(path, _outside):
    path.unlink()
    path.symlink_to("/dev/zero")


def empty(path, _outside):
    path.write_bytes(b"")


@pytest.fixture
def read_by_every_command(
    folder_of_run, tmp_path, capsys, monkeypatch, only_svg, blank, request
):
    """Run each command that reads a folder, with resource limits; none may raise.

    Slow tests draw the figures of the pages.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(os, "getloadavg", lambda: (0.1, 0.1, 0.1))
    suite = tmp_path / "s.toml"
    shutil.copy(folder_of_run.with_name("s.toml"), suite)

    def read(folder, run_ids):
        for arguments in (
            ("report", folder), ("report", folder, folder),
            *(("replay", folder, run_id) for run_id in run_ids),
            ("merge", folder, "--out", tmp_path / "merged"),
            ("validate", folder), ("run", suite, "--out", folder),
        ):  # fmt: skip
            with bounded():
                code = main(Registries(), [*map(str, arguments)])
            said = capsys.readouterr().err.splitlines()
            assert code in (0, 1, 2), "\n".join([*map(str, arguments), *said])
            lines = [line for line in said if line.startswith("mortarbench: ")]
            assert code < 2 or (lines and len(lines[-1]) < 1500), (arguments, said)
            assert not any("Traceback" in line for line in said), said
            shutil.rmtree(tmp_path / "merged", ignore_errors=True)
        with bounded(), suppress(InputError):
            assert mb.load(folder).df.shape[0] >= 1

    slow = request.node.get_closest_marker("slow")
    with nullcontext() if slow else blank():
        yield read


def try_commands(folder_of_run, tmp_path, name, kind, read):
    folder, outside = tmp_path / "run", tmp_path / "outside"
    shutil.copytree(folder_of_run, folder)
    outside.mkdir()
    (outside / "precious").write_text("precious")
    run_ids = [record.run_id for record in read_journal(folder)]
    kind(folder / name, outside)

    read(folder, run_ids)

    assert [path.name for path in outside.iterdir()] == ["precious"]
    assert (outside / "precious").read_text() == "precious"


QUICK = (pipe, dangling, foreign, endless)
SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    ("kind", "which"),
    [
        *((kind, "environment.json") for kind in QUICK),
        *(
            pytest.param(kind, "*", marks=SLOW)
            for kind in (*QUICK, with_zeros, below_the_limit, a_folder, empty)
        ),
    ],
)
def test_every_file_of_a_folder_is_read_or_refused_by_every_command(
    folder_of_run, tmp_path, kind, which, read_by_every_command
):
    names = [n for n in kinds_of_files(folder_of_run) if fnmatch(n, which)]
    assert names
    for i, name in enumerate(names):
        try_commands(
            folder_of_run, tmp_path / str(i), name, kind, read_by_every_command
        )


@pytest.fixture
def folder_copy(folder_of_run, tmp_path):
    """Copy a folder; rm removes the copy, since pytest exceeds the recursion limit."""
    folder = tmp_path / "run"
    shutil.copytree(folder_of_run, folder)
    yield folder
    subprocess.run(["rm", "-rf", folder], check=True)


@pytest.mark.parametrize("part", ["vectors", "journal"])
def test_folders_nested_without_end_are_refused_in_one_line(folder_copy, part, capsys):
    folder = folder_copy
    (folder / part).mkdir(exist_ok=True)
    here = os.open(folder / part, os.O_RDONLY)
    for _ in range(3000):
        os.mkdir("d", dir_fd=here)
        inner = os.open("d", os.O_RDONLY, dir_fd=here)
        os.close(here)
        here = inner
    os.close(here)

    for command in ("report", "validate"):
        assert main(Registries(), [command, str(folder)]) == 2
        said = capsys.readouterr().err
        assert said.count("\n") == 1
        assert (
            f"{folder / part}: folders nested deeper than 30 levels; expected" in said
        )
    with pytest.raises(InputError, match="nested deeper"):
        mb.load(folder)
