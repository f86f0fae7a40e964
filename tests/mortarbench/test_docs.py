"""What the documents show works."""

import re

from harness import kkt_residuals
from harness.registry import load_plugin
from mortarbench.cli.solvers_page import solvers_page
from mortarbench.listing import about
from problems.families.beam_ring import BeamRing
from solvers import SOLVERS
from solvers.reference.solve import reference_solution
from tests.support import ROOT


def test_the_solver_of_the_contributing_guide_solves(tmp_path):
    """In under 30 lines, and right on a dual with bounds only."""
    _, code = re.findall(
        r"```python\n(.*?)```", (ROOT / "CONTRIBUTING.md").read_text(), re.S
    )
    path = tmp_path / "lbfgsb.py"
    path.write_text(code)
    solver = load_plugin(path).solvers["lbfgsb"]
    family = BeamRing()
    params = family.complete({"Nr": 4, "Nh": 3, "steps": 1})
    qp = family.build("dual-bounds", params, reference_solution).qp
    s = solver.prepare(qp, 1e-8)()

    assert len(code.splitlines()) < 30
    assert solver.declines(family.build("primal", params, reference_solution).qp)
    assert kkt_residuals(qp, s).primal == 0
    assert qp.objective(s.x) - qp.objective(reference_solution(qp).x) <= 1e-7 * abs(
        qp.objective(s.x)
    )


def test_the_adapter_that_the_contributing_guide_shows_is_the_real_one():
    shown, _ = re.findall(
        r"```python\n(.*?)```", (ROOT / "CONTRIBUTING.md").read_text(), re.S
    )
    assert shown == (ROOT / "solvers/adapters/piqp_.py").read_text()


def test_the_page_of_solvers_is_up_to_date():
    """`make docs` writes it."""
    assert (ROOT / "docs/solvers.md").read_text() == solvers_page(SOLVERS)


def test_the_page_of_solvers_tells_the_facts_of_each():
    page = solvers_page(SOLVERS)
    for name, solver in SOLVERS.items():
        assert f"| `{name}` |" in page
        facts = about(solver)
        for fact in (facts.licence, facts.phases, *facts.limits) if facts else ():
            assert fact in page
    assert "| `max_iter` | 250 | 250 | 250 |  |" in page
    assert "| `backend` | 'auto' | 'dense' | 'sparse' | auto: as P is stored |" in page


def test_every_family_and_suite_that_the_readme_names_exists():
    from problems import PROBLEMS

    text = (ROOT / "README.md").read_text()

    names = re.findall(r"mortarbench solve ([\w-]+)[/:]", text)
    assert {"beam-ring", "contact-patch", "file"} <= set(names) <= set(PROBLEMS)
    for suite in re.findall(r"suites/[\w-]+\.toml", text):
        assert (ROOT / suite).is_file()
