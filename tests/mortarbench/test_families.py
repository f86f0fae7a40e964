"""Every family that needs no file, run from the command line."""

import json

import pytest

from mortarbench.cli.main import main
from mortarbench.problems import PROBLEMS
from mortarbench.registries import Registries
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.reference.solve import reference_solution

#: forms that take longer than another form, which is solved in every run;
#: test_hertz_sphere.py solves the dual form of spheres in every run
LATER = {
    "hertz-sphere": ("primal", "dual"), "plate": ("dual",),
    "cantilever": ("primal",), "hertz-cylinder": ("primal",),
    "hertz-plane": ("primal",), "beam-ring": ("primal", "dual"),
    "cube-wall": ("primal", "dual"), "greco": ("primal", "dual-bounds"),
    "membranes": ("dual",), "obstacle": ("dual", "dual-bounds"),
    "contact-patch": ("dual",),
}  # fmt: skip
CASES = [
    pytest.param(name, form, marks=[pytest.mark.slow] * (form in LATER.get(name, ())))
    for name, family in PROBLEMS.items()
    if family.path_suffix is None
    for form in family.forms
]


@pytest.mark.parametrize(("name", "form"), CASES)
def test_the_default_case_is_solved_and_verified_in_every_form(name, form, capsys):
    registries = Registries(
        families=PROBLEMS, solvers=SOLVERS, reference=reference_solution,
    )  # fmt: skip
    declined = SOLVERS["smalbe"].declines(
        PROBLEMS[name].build(form, reference_solution).qp
    )
    solver = "clarabel" if declined else "smalbe"
    code = main(registries, ["solve", f"{name}/{form}", "--solver", solver, "--json"])
    record = json.loads(capsys.readouterr().out)

    assert (code, record["status"]) == (0, "verified")
    assert record["case"] == f"{name}/{form}"
    assert record["quantities"]["energy"]
