"""Files of QPs are copied to the result folder, from which a run can be continued."""

import json
import shutil
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest

import mortarbench as mb
from mortarbench.cli.main import main
from mortarbench.harness import InputError
from mortarbench.harness.files import copies
from mortarbench.harness.files.copies import Copies, keep_copies
from mortarbench.harness.plugin import SourceFile
from mortarbench.harness.results.journal import read_journal
from mortarbench.registries import Registries

pytestmark = pytest.mark.together  # all tests use the same run

SUITE = """
name = "s"
repeats = 1
solvers = ["clarabel"]
[[problems]]
family = "file"
params = {{ path = {} }}
"""


def write_qp(path, bound):
    """Write min ½xᵀx − 3·1ᵀx, x ≤ bound < 3; at the solution, both xᵢ equal
    the bound.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, P=np.eye(2), q=-3 * np.ones(2), ub=np.full(2, bound))


def digest(path):
    return sha256(path.read_bytes()).hexdigest()[:12]


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """Create a folder with a suite, its QP and results; tests must not change it."""
    folder = tmp_path_factory.mktemp("there")
    write_qp(folder / "qps" / "qp.npz", 0.5)
    (folder / "s.toml").write_text(SUITE.format('"qps/qp.npz"'))
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        mb.run("s.toml", out="run")
    return folder


@pytest.fixture
def here(measured, tmp_path, monkeypatch):
    """Change to a directory that contains only the result folder."""
    shutil.copytree(measured / "run", tmp_path / "run")
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def copy(here):
    (found,) = (here / "run" / "files").glob("*.npz")
    return found


@pytest.fixture
def cli(capsys):
    def cli(*argv):
        code = main(Registries(), [*map(str, argv)])
        return code, *capsys.readouterr()

    return cli


def test_each_content_is_copied_under_its_digest(measured, here, copy):
    assert copy.name == f"{digest(measured / 'qps' / 'qp.npz')}.npz"
    assert copy.read_bytes() == (measured / "qps" / "qp.npz").read_bytes()


def test_a_copied_folder_can_be_validated_replayed_and_reported(here, svg_only):
    (record,) = read_journal(here / "run")

    found = mb.validate("run")
    again = mb.replay("run", record.run_id)
    with svg_only():
        report = mb.report("run")

    assert found.agreed
    assert found.data["counts"]["answers"] == 1
    assert again.reproduced
    assert again.same_qp is True
    assert again.now.case == record.case == "file:qps/qp.npz"
    assert again.distance == 0
    assert report.files


def test_a_run_in_a_copied_folder_continues(here):
    results = mb.run("run/suite.toml", out="run", repeats=2)

    assert [r.status.value for r in results.records] == ["verified"] * 2
    assert {r.params["sha256"] for r in results.records} == {
        results.records[0].params["sha256"]
    }
    assert not results.shortfall


def test_a_pattern_matches_files_that_no_longer_exist(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, bound in (("a", 0.25), ("b", 0.5)):
        write_qp(tmp_path / "qps" / f"{name}.npz", bound)
    (tmp_path / "s.toml").write_text(SUITE.format('"qps/*.npz"'))
    before = mb.run("s.toml", out="run")
    (tmp_path / "qps" / "b.npz").unlink()

    partly = mb.run("s.toml", out="run", repeats=2)
    shutil.rmtree(tmp_path / "qps")
    after = mb.run("s.toml", out="run", repeats=3)

    assert [len(r) for r in (before, partly, after)] == [2, 4, 6]
    assert {r.case for r in after.records} == {"file:qps/a.npz", "file:qps/b.npz"}


def test_a_path_from_the_folder_of_the_suite_is_found_again(tmp_path, monkeypatch):
    (tmp_path / "work").mkdir()
    monkeypatch.chdir(tmp_path / "work")
    write_qp(tmp_path / "suites" / "qp.npz", 0.5)
    (tmp_path / "suites" / "s.toml").write_text(SUITE.format('"qp.npz"'))
    mb.run("../suites/s.toml", out="run")
    (tmp_path / "suites" / "qp.npz").unlink()

    after = mb.run("run/suite.toml", out="run", repeats=2)

    assert [r.case for r in after.records] == ["file:../suites/qp.npz"] * 2


def test_the_copy_is_used_if_the_original_has_changed(here):
    (record,) = read_journal(here / "run")
    write_qp(here / "qps" / "qp.npz", 0.75)

    again = mb.replay("run", record.run_id)
    found = mb.validate("run")

    assert again.reproduced
    assert again.distance == 0
    assert found.agreed


def test_a_changed_original_is_another_problem_to_a_run(here, cli):
    write_qp(here / "qps" / "qp.npz", 0.75)

    code, _, said = cli("run", "run/suite.toml", "--out", "run")

    assert code == 2
    assert f"now {digest(here / 'qps' / 'qp.npz')}" in said


def commands(here):
    (record,) = read_journal(here / "run")
    return (
        ("validate", "run"), ("replay", "run", record.run_id),
        ("run", "run/suite.toml", "--out", "run", "--repeats", "2"),
        ("merge", "run", "--out", "merged"),
    )  # fmt: skip


def test_an_exchanged_copy_is_refused_in_one_line(here, copy, cli):
    right = digest(copy)
    write_qp(copy, 0.75)

    for arguments in commands(here):
        code, _, said = cli(*arguments)
        last = said.splitlines()[-1]
        assert code == 2
        assert f"{copy.relative_to(here)}: its content has the digest" in last
        assert digest(copy) in last
        assert right in last
    assert not (here / "merged").exists()


def test_a_missing_file_is_named_with_its_digest(here, copy, cli):
    right = digest(copy)
    copy.unlink()

    for arguments in commands(here)[:3]:
        code, _, said = cli(*arguments)
        last = said.splitlines()[-1]
        assert code == 2
        assert (
            f"qp.npz (sha256 {right}) is not available and has no copy in "
            "run/files; put it at qps/qp.npz"
        ) in last


def test_a_restored_file_is_used(measured, here, copy):
    copy.unlink()
    shutil.copytree(measured / "qps", here / "qps")

    mb.run("run/suite.toml", out="run", repeats=2)

    assert copy.exists()  # the file is copied again


def test_a_damaged_copy_is_replaced_if_the_original_exists(measured, here, copy):
    right = copy.read_bytes()
    copy.write_bytes(b"damaged")
    shutil.copytree(measured / "qps", here / "qps")

    mb.run("run/suite.toml", out="run", repeats=2)

    assert copy.read_bytes() == right


def test_files_that_are_too_large_are_not_copied_but_named(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with Path("large.npz").open("wb") as file:
        file.truncate(70 * 2**20)
    source = SourceFile(
        path="large.npz", sha256=digest(Path("large.npz")), suffix=".npz"
    )
    said = []

    keep_copies(tmp_path / "run", [source], said.append)
    assert Copies(tmp_path / "run").locate(source) == Path("large.npz")
    Path("large.npz").unlink()

    assert [p.name for p in (tmp_path / "run" / "files").iterdir()] == ["copies.json"]
    assert said == [
        "large.npz (70 MiB) is larger than 64 MiB, "
        "and is not copied to the result folder"
    ]
    with pytest.raises(InputError) as refused:
        Copies(tmp_path / "run").locate(source)
    assert str(refused.value) == (
        f"large.npz (sha256 {source.sha256}) is not available and was too large to "
        "be copied with the results (70 MiB); put it at large.npz"
    )


def test_copies_of_a_folder_have_a_common_size_limit(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(copies, "MAX_FOLDER_MIB", 2)
    sources = []
    for i in range(3):
        path = Path(f"{i}.mat")
        path.write_bytes(bytes([i]) * 2**20)
        sources.append(SourceFile(path=f"{i}.mat", sha256=digest(path), suffix=".mat"))
    said = []

    for _ in range(2):  # the second run copies no file
        keep_copies(tmp_path / "run", sources, said.append)

    kept = {p.name for p in (tmp_path / "run" / "files").glob("*.mat")}
    assert kept == {f"{s.sha256}.mat" for s in sources[:2]}
    assert len(said) == 2
    assert said[0].startswith("2.mat (1 MiB) is not copied to the result folder")


@pytest.mark.slow
def test_merged_folders_have_one_copy_of_a_file_at_two_paths(
    measured, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(measured / "run", "one")
    (tmp_path / "other").mkdir()
    shutil.copy(measured / "qps" / "qp.npz", tmp_path / "other" / "same.npz")
    mb.run(
        {"name": "t", "repeats": 1, "solvers": ["clarabel"],
         "problems": [{"family": "file", "params": {"path": "other/same.npz"}}]},
        out="two",
    )  # fmt: skip
    shutil.rmtree(tmp_path / "other")

    for _ in range(2):  # the second merge changes nothing
        mb.merge("one", "two", out="both")

    (kept,) = (tmp_path / "both" / "files").glob("*.npz")
    assert kept.stem == digest(kept)
    listed = json.loads((tmp_path / "both" / "files" / "copies.json").read_text())
    paths = [entry["path"] for entry in listed["files"]]
    assert paths == ["qps/qp.npz", "other/same.npz"]
    found = mb.validate("both")
    assert found.agreed
    assert found.data["counts"]["answers"] == 2
    for record in read_journal(tmp_path / "both"):
        assert mb.replay("both", record.run_id).reproduced


@pytest.mark.parametrize("digits", ["../../secret", "a/b", "", "0" * 64])
def test_a_digest_in_a_journal_cannot_lead_out_of_the_folder(here, digits):
    (here / "secret.npz").write_bytes(b"secret")
    source = SourceFile(path="qps/qp.npz", sha256=digits, suffix=".npz")

    with pytest.raises(InputError, match="is not a digest; expected 12 hex digits"):
        Copies(here / "run").locate(source)


def test_paths_of_the_list_are_never_opened(here, copy, tmp_path):
    listed = here / "run" / "files" / "copies.json"
    entry = {"path": "../outside.npz", "sha256": "0" * 12, "size": 1}
    listed.write_text(json.dumps({"files": [entry]}))
    write_qp(tmp_path.parent / "outside.npz", 0.75)
    try:
        mb.merge("run", out="merged")
    finally:
        (tmp_path.parent / "outside.npz").unlink()

    assert [p.name for p in (here / "merged" / "files").glob("*.npz")] == [copy.name]


@pytest.mark.parametrize(
    "text",
    ["[]", "{}", '{"files": 3}', '{"files": [{"path": 1, "sha256": "", "size": 0}]}',
     '{"files": [[]]}', '{"files": [{"path": "a", "sha256": "/", "size": 1e3}]}'],
)  # fmt: skip
def test_a_list_that_no_run_wrote_is_refused_in_one_line(here, cli, text):
    (here / "run" / "files" / "copies.json").write_text(text)

    code, _, said = cli("run", "run/suite.toml", "--out", "run")

    assert code == 2
    assert "copies.json: malformed list of copied files" in said


def test_fresh_deletes_copies_and_nothing_else_in_their_folder(measured, here, copy):
    shutil.copytree(measured / "qps", here / "qps")
    (here / "run" / "files" / "of-the-user.mat").write_text("mine")
    stale = here / "run" / "files" / "0123456789ab.mat"
    stale.write_text("stale")

    mb.run("run/suite.toml", out="run", fresh=True)

    assert not stale.exists()
    assert copy.exists()
    assert (here / "run" / "files" / "of-the-user.mat").read_text() == "mine"


def test_fresh_does_not_delete_the_files_to_be_measured(here, copy, cli):
    (here / "s.toml").write_text(SUITE.format(f'"{copy.relative_to(here)}"'))

    code, _, said = cli("run", "s.toml", "--out", "run", "--fresh")

    assert code == 2
    assert "is a copy that --fresh deletes; put the file elsewhere" in said
    assert copy.exists()


def test_folders_of_the_user_called_files_are_left_alone(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_qp(tmp_path / "elsewhere.npz", 0.5)
    (tmp_path / "files").mkdir()
    (tmp_path / "files" / "qp.npz").symlink_to(tmp_path / "elsewhere.npz")
    (tmp_path / "s.toml").write_text(SUITE.format('"files/qp.npz"'))

    results = mb.run("s.toml", out=".")

    assert [r.status.value for r in results.records] == ["verified"]
    assert (tmp_path / "files" / "qp.npz").is_symlink()


def test_a_link_among_copies_is_refused(here, copy, cli):
    moved = copy.rename(here / "elsewhere.npz")
    copy.symlink_to(moved)

    for arguments in (("validate", "run"), ("run", "run/suite.toml", "--out", "run")):
        code, _, said = cli(*arguments)
        assert code == 2
        assert f"{copy.name} is not a regular file" in said


def test_a_list_of_the_user_does_not_affect_a_run_without_files(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "files").mkdir()
    (tmp_path / "files" / "copies.json").write_text("mine")
    problem = {"family": "obstacle", "forms": ["primal"], "params": {"dim": 1, "n": 4}}
    suite = {"name": "t", "repeats": 1, "solvers": ["clarabel"], "problems": [problem]}

    assert len(mb.run(suite, out=".")) == 1
    assert (tmp_path / "files" / "copies.json").read_text() == "mine"
