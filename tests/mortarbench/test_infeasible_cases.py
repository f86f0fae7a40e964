"""A correct claim of infeasibility is an answer, from the solver to the report."""

import json

import pytest

import mortarbench as mb
from mortarbench.cli.main import main as command_line
from mortarbench.harness import Verdict
from mortarbench.harness.conformance.manufactured import (
    infeasible,
    manufactured,
    unbounded,
)
from mortarbench.harness.files.qpfile import save_qp
from mortarbench.registries import Registries
from mortarbench.reports.measurements import read_measurements


def main(argv):
    return command_line(Registries(), argv)


@pytest.fixture
def qps(tmp_path):
    problems = {
        "none": infeasible(),
        "some": manufactured("inequalities")[0],
        "far": unbounded(),
    }
    for name, qp in problems.items():
        save_qp(tmp_path / f"{name}.npz", qp, {"name": name})
    return tmp_path


def write(folder, *names):
    paths = ", ".join(f'"{folder / name}.npz"' for name in names)
    text = (
        'name = "claims"\ntolerances = [1e-6]\nrepeats = 1\n'
        'solvers = ["osqp", "daqp"]\n[[problems]]\nfamily = "file"\n'
        f"params = {{ path = [{paths}] }}\n"
    )
    path = folder / "claims.toml"
    path.write_text(text)
    return str(path)


def test_solve_reports_verified_infeasibility(qps, capsys):
    assert main(["solve", f"file:{qps}/none.npz", "--solver", "osqp"]) == 0
    assert "verified infeasible (claimed infeasible)" in capsys.readouterr().out
    assert main(["solve", f"file:{qps}/none.npz", "--solver", "osqp", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["status"] == "verified_infeasible"


def test_a_claim_that_the_objective_is_unbounded_is_verified(qps, capsys):
    assert main(["solve", f"file:{qps}/far.npz", "--solver", "osqp", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["status"] == "verified_unbounded"


@pytest.mark.usefixtures("blank_figures")
def test_verified_infeasibility_passes_a_strict_run(qps, tmp_path, capsys):
    out = tmp_path / "out"
    path = write(qps, "none", "some")
    assert main(["run", path, "--out", str(out), "--strict"]) == 0
    found = mb.load(out)
    assert not found.refuted
    assert not found.failed
    count = {r.status for r in found.records}
    assert count == {Verdict.VERIFIED, Verdict.VERIFIED_INFEASIBLE}
    for factor in (10.0, 0.01, 1e4):
        answers = read_measurements(out, factor).answers
        assert [*answers[answers.case.str.contains("none")].verified] == [True] * 2
    assert main(["validate", str(out)]) == 0
    capsys.readouterr()
    main(["report", str(out), "--format", "md"])
    page = (out / "report" / "report.md").read_text()
    assert "4 answers verified, 0 claims refuted" in page


def test_a_folder_of_infeasible_cases_is_validated_and_forged_proofs_detected(
    qps, tmp_path, capsys
):
    out = tmp_path / "out"
    main(["run", write(qps, "none"), "--out", str(out)])
    capsys.readouterr()
    assert main(["validate", str(out)]) == 0
    assert "2 claims of infeasibility proven" in capsys.readouterr().out

    forged = tmp_path / "forged"
    main(["run", write(qps, "some"), "--out", str(forged)])
    (journal,) = (forged / "journal").glob("*.jsonl")
    lines = journal.read_text()
    for true, false in (("solved", "infeasible"), ("verified", "verified_infeasible")):
        assert f'"{true}"' in lines
        lines = lines.replace(f'"{true}"', f'"{false}"')
    journal.write_text(lines)
    capsys.readouterr()
    assert main(["validate", str(forged)]) in (1, 2)
    captured = capsys.readouterr()
    assert "the certificate could not be computed again" in captured.out + captured.err
