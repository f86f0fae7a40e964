"""Every family that needs no file, run from the command line."""

import json

import pytest

from mortarbench.cli.main import main
from mortarbench.problems import PROBLEMS
from mortarbench.registries import Registries
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.reference.solve import reference_solution

#: default cases that take seconds; test_hertz_sphere.py solves the dual in every run
LARGE = [("hertz-sphere", "primal"), ("hertz-sphere", "dual")]
CASES = [
    pytest.param(name, form, marks=[pytest.mark.slow] * ((name, form) in LARGE))
    for name, family in PROBLEMS.items()
    if "path" not in family.defaults
    for form in family.forms
]


@pytest.mark.parametrize(("name", "form"), CASES)
def test_the_default_case_is_solved_and_verified_in_every_form(name, form, capsys):
    registries = Registries(
        families=PROBLEMS, solvers=SOLVERS, reference=reference_solution,
        report=None,
    )  # fmt: skip
    declined = SOLVERS["smalbe"].declines(
        PROBLEMS[name].build(form, _defaults(name), reference_solution).qp
    )
    solver = "clarabel" if declined else "smalbe"
    code = main(registries, ["solve", f"{name}/{form}", "--solver", solver, "--json"])
    record = json.loads(capsys.readouterr().out)

    assert (code, record["status"]) == (0, "verified")
    assert record["case"] == f"{name}/{form}"
    assert record["quantities"]["energy"]


def _defaults(name):
    family = PROBLEMS[name]
    complete = getattr(family, "complete", lambda given: {**family.defaults, **given})
    return complete({})
