"""A correct claim of infeasibility is an answer, from the solver to the report."""

import json

import pytest

import mortarbench as mb
from mortarbench.harness import Verdict
from mortarbench.harness.conformance.manufactured import (
    infeasible,
    manufactured,
    unbounded,
)
from mortarbench.harness.files.qpfile import save_qp
from mortarbench.reports.measurements import read_measurements


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


@pytest.mark.parametrize(
    ("name", "status"), [("none", "verified_infeasible"), ("far", "verified_unbounded")]
)
def test_solve_verifies_claims(qps, command, name, status):
    solve = ("solve", f"file:{qps}/{name}.npz", "--solver", "osqp")
    code, out, _ = command(*solve, "--json")
    assert (code, json.loads(out)["status"]) == (0, status)
    assert f"{status.replace('_', ' ')} (claimed " in command(*solve)[1]


@pytest.mark.usefixtures("blank_figures")
def test_verified_infeasibility_passes_a_strict_run(qps, tmp_path, command):
    out = tmp_path / "out"
    path = write(qps, "none", "some")
    assert command("run", path, "--out", out, "--strict")[0] == 0
    found = mb.load(out)
    assert not found.refuted
    assert not found.failed
    count = {r.status for r in found.records}
    assert count == {Verdict.VERIFIED, Verdict.VERIFIED_INFEASIBLE}
    for factor in (10.0, 0.01, 1e4):
        answers = read_measurements(out, factor).answers
        assert [*answers[answers.case.str.contains("none")].verified] == [True] * 2
    assert command("validate", out)[0] == 0
    command("report", out, "--format", "md")
    page = (out / "report" / "report.md").read_text()
    assert "4 answers verified, 0 claims refuted" in page
