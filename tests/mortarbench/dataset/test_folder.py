"""The public set: every change of a file is found, and a rebuild has the same bytes."""

import csv
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import mortarbench as mb
from mortarbench.cli.main import main as command_line
from mortarbench.dataset import folder as folders
from mortarbench.dataset.items import catalogue, objections
from mortarbench.harness.files.store import write_arrays
from mortarbench.registries import Registries

pytestmark = pytest.mark.together

#: small items of every kind, and the first steps of a sequence
NAMES = (
    "contact-patch-dual",
    "torsion-n12-primal",
    "half-space-n8-lawmindlin-Q0.1-dual",
    "membranes-n4-primal-reversed",
    "membranes-n4-dual-reversed",
    "half-plane-n80-lawcattaneo-Q-dual/001",
    "half-plane-n80-lawcattaneo-Q-dual/002",
)
PATCH = "problems/contact-patch-dual.npz"


def main(*argv):
    return command_line(Registries(), argv)


def few():
    rows = {row["name"]: row for row in catalogue()}
    return [rows[name] for name in NAMES]


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(folders, "catalogue", few)
        return mb.dataset.build(tmp_path_factory.mktemp("set") / "new", everything=True)


@pytest.fixture
def copy(built, tmp_path):
    return Path(shutil.copytree(built, tmp_path / "copy"))


def rewrite_catalogue(folder, name, **changes):
    """Change a line, and make the checksum of the catalogue that of the new one."""
    path = folder / "catalogue.csv"
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    for row in rows:
        if row["name"] == name:
            row |= {k: change(row[k]) for k, change in changes.items()}
    folders.write_catalogue(folder, rows)
    sums = (folder / "CHECKSUMS").read_text().splitlines(keepends=True)
    sums[0] = f"{folders._digest(path)}  catalogue.csv\n"
    (folder / "CHECKSUMS").write_text("".join(sums))


def test_a_new_set_passes_and_contains_what_an_archive_needs(built, capsys):
    assert main("dataset", "check", str(built)) == 0
    assert "every optimum is proven" in capsys.readouterr().out
    names = {path.name for path in built.iterdir()}
    assert names >= {
        "README.md",
        "LICENSE",
        "CITATION.cff",
        "CHECKSUMS",
        "selection.py",
    }


def refuted(folder, capsys):
    """Return the only line that refutes a set."""
    assert main("dataset", "check", str(folder)) == 1
    (line,) = capsys.readouterr().out.splitlines()
    return line


@pytest.mark.parametrize("name", [PATCH, "README.md", "catalogue.csv"])
def test_a_flipped_bit_is_found(copy, capsys, name):
    data = bytearray((copy / name).read_bytes())
    data[-20] ^= 1
    (copy / name).write_bytes(data)
    main("dataset", "check", str(copy))
    assert name in capsys.readouterr().out


@pytest.mark.parametrize(
    "name", [PATCH, f"certificates/{PATCH}", "LICENSE", "contact_qpbenchmark.py"]
)
def test_a_missing_file_is_found(copy, capsys, name):
    (copy / name).unlink()
    assert name in refuted(copy, capsys)


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [
        ("torsion-n12-primal", {"optimum": lambda f: repr(float(f) + 3e-9)}, "refuted"),
        ("torsion-n12-primal", {"bound": lambda _: "1e-7"}, "expected at most 1e-08"),
        ("membranes-n4-dual-reversed", {"kind": lambda _: "unbounded"}, "vector x"),
        ("torsion-n12-primal", {"kind": lambda _: "infeasible"}, "not prove"),
        ("torsion-n12-primal", {"kind": lambda _: "nice"}, "cannot be checked"),
        ("torsion-n12-primal", {"optimum": lambda _: "low"}, "cannot be checked"),
        ("torsion-n12-primal", {"active_share": lambda _: "0.9"}, "not the published"),
    ],
)
def test_a_changed_claim_is_refuted(copy, capsys, name, changes, message):
    rewrite_catalogue(copy, name, **changes)
    line = refuted(copy, capsys)
    assert message in line
    assert name in line


@pytest.mark.parametrize("name", NAMES)
def test_a_wrong_certificate_proves_nothing(copy, capsys, name):
    (row,) = (row for row in few() if row["name"] == name)
    path = copy / "certificates" / row["path"]
    with np.load(path) as data:
        proof = {k: data[k] for k in data}
    key = {"infeasible": "y", "unbounded": "ray"}.get(row["kind"], "x")
    for wrong in (
        0 * proof[key],
        -proof[key],
        np.full_like(proof[key], np.nan),
        proof["x"][:3] if "x" in proof else proof["y"][:1],
    ):
        write_arrays(path, proof | {key: wrong})
        assert row["path"] in refuted(copy, capsys)


def test_a_file_that_is_no_certificate_is_named(copy, capsys):
    (copy / "certificates" / PATCH).write_text("nonsense")
    assert PATCH in refuted(copy, capsys)


def test_the_certificates_hold_for_no_other_problem(built):
    first, other = (
        mb.build(f"file:{built}/{row['path']}").qp for row in (few()[0], few()[1])
    )
    with np.load(built / "certificates" / PATCH) as data:
        proof = {k: data[k] for k in data}
    assert [*objections(few()[0], first, proof)] == []
    assert [*objections(few()[0], other, proof)] != []


def test_an_interrupted_build_continues_and_leaves_finished_items(copy, monkeypatch):
    before = {p: p.read_bytes() for p in copy.rglob("*") if p.is_file()}
    (copy / PATCH).unlink()
    (copy / "CHECKSUMS").unlink()
    said = []
    monkeypatch.setattr(folders, "catalogue", few)
    mb.dataset.build(copy, everything=True, progress=said.append)
    assert [line.split()[1] for line in said] == ["contact-patch-dual"]
    assert {p: p.read_bytes() for p in copy.rglob("*") if p.is_file()} == before


REBUILD = """
import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from mortarbench.dataset.folder import write_problem
from mortarbench.dataset.items import catalogue
from mortarbench.dataset.selection import described
rows = {row["name"]: row for row in catalogue()}
for name in sys.argv[1:]:
    old = rows[name]
    if not old["sequence"]:  # whose scales are those of the last step
        new = described(dict(old))  # without stored bits, so that f* is not the same
        change = {k for k in old if new[k] != old[k]}
        assert change <= {"optimum", "bound", "energy_constant"}, (name, change)
        if old["kind"] == "optimal":
            error = abs(float(new["optimum"]) - float(old["optimum"]))
            assert error <= float(old["bound"]), name
with TemporaryDirectory() as folder:
    for name in sys.argv[1:]:
        path = Path(folder, "item.npz")
        assert write_problem(rows[name], path) == rows[name]["digest"], name
"""


def rebuilt_under(kernel, names):
    environment = os.environ | {"OPENBLAS_CORETYPE": kernel}
    command = [sys.executable, "-c", REBUILD, *names]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("kernel", ["Prescott", "SkylakeX"])
def test_a_rebuild_under_another_kernel_of_blas_has_the_same_bytes(kernel):
    rebuilt_under(kernel, [*NAMES, "obstacle-n8-dual"])


@pytest.mark.slow
@pytest.mark.parametrize("kernel", ["Sandybridge", "Prescott"])
def test_the_whole_core_has_the_same_bytes_under_another_kernel(kernel):
    rebuilt_under(kernel, [r["name"] for r in catalogue() if r["core"] == "yes"])


def test_the_published_set_has_what_it_promises():
    rows = catalogue()
    core = [row for row in rows if row["core"] == "yes"]
    assert 50 <= len(core) <= 70
    assert len({row["name"] for row in rows}) == len(rows)
    for row in rows:
        if row["kind"] == "optimal":
            assert float(row["bound"]) <= 1e-8 * max(1, abs(float(row["optimum"])))
    steps = {}
    for row in rows:
        if row["sequence"]:
            steps.setdefault(row["sequence"], []).append(int(row["step"]))
    assert len(steps) >= 20
    for numbers in steps.values():
        assert numbers == [*range(1, len(numbers) + 1)]
        assert len(numbers) >= 3
    assert {row["kind"] for row in core} == {"optimal", "infeasible", "unbounded"}
    assert (folders.HERE / "bits.npz").stat().st_size <= 5e6


def test_bad_folders_are_refused_in_one_line(tmp_path, capsys):
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "mine.txt").write_text("")
    for argv in (
        ("build", "--out", str(tmp_path / "full")),
        ("build", "--out", str(tmp_path / "full" / "mine.txt")),
        ("check", str(tmp_path)),
        ("check", str(tmp_path / "none")),
    ):
        assert main("dataset", *argv) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert "expected" in line
    assert [*(tmp_path / "full").iterdir()] == [tmp_path / "full" / "mine.txt"]


def test_a_catalogue_with_other_columns_is_refused(copy, capsys):
    (copy / "catalogue.csv").write_text("name,path\na,b\n")
    assert main("dataset", "check", str(copy)) == 2
    assert "expected the columns" in capsys.readouterr().err


def test_info_fits_on_a_screen(capsys):
    assert main("dataset", "info") == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) <= 24
    assert any(line.startswith("core") for line in lines)


def test_the_own_command_of_qpbenchmark_runs_the_set(built, tmp_path):
    pytest.importorskip("qpbenchmark")
    results = tmp_path / "results.csv"
    run = [
        sys.executable,
        "-m",
        "qpbenchmark.benchmark",
        "--results-path",
        str(results),
    ]
    run += [str(built / "contact_every.py"), "run", "--author", "test"]
    done = subprocess.run(
        [*run, "--solver", "piqp"], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 0, done.stderr
    with results.open(newline="") as file:
        rows = [
            row for row in csv.DictReader(file) if row["settings"] == "high_accuracy"
        ]
    assert {row["problem"] for row in rows} == {
        "contact-patch-dual",
        "torsion-n12-primal",
    }
    assert all(float(row["duality_gap"]) <= 1e-8 for row in rows)


def test_the_optima_of_qpbenchmarks_solvers_are_ours(built):
    pytest.importorskip("qpbenchmark")
    import qpsolvers

    sys.path.append(str(built))
    try:
        from contact_every import ContactEvery

        problems = {problem.name: problem for problem in ContactEvery()}
    finally:
        sys.path.remove(str(built))
    optima = {row["name"]: float(row["optimum"] or "nan") for row in few()}
    for name, problem in problems.items():
        found = qpsolvers.solve_problem(
            problem, "clarabel", tol_gap_abs=1e-12, tol_gap_rel=1e-12, tol_feas=1e-12
        )
        assert abs(found.obj - optima[name]) < 1e-8


def test_an_own_solver_gets_its_place(copy, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for name in NAMES:
        rewrite_catalogue(copy, name, core=lambda _: "yes")
    assert main("new", "solver", "mine") == 0
    named = [a for name in ("pdas", "daqp", "mine") for a in ("--solver", name)]
    board = ("dataset", "leaderboard", str(copy), "--plugin", "mine.py", *named)
    assert main(*board) == 0
    said = capsys.readouterr().out
    report = tmp_path / "out/leaderboard/report"
    text = (report / "leaderboard.md").read_text()
    records = pd.read_parquet(report / "records.parquet")

    assert "dense, tol 1e-6" in said
    for name in ("pdas", "daqp", "mine"):
        assert name in text
    for group in ("dense", "sparse", "discs", "no solution", "sequences"):
        assert f"\n| {group}<br>" in text
    assert "Warm starts cost time" in text
    assert len(records) == len(mb.load("out/leaderboard").df)
    assert set(records.solver) == {"pdas", "daqp", "mine"}
    assert (records.total_seconds[records.status == "verified"] > 0).all()
