"""Examples in the docstrings of exported functions print the output that is shown."""

import doctest
from importlib import import_module

import pytest

import mortarbench as mb
from mortarbench.listing import problems, solvers
from mortarbench.solvers.reference.solve import reference_solution
from tests.support import ROOT

#: modules of the packages that `mortarbench` imports, with examples
MODULES = [
    str(path.relative_to(ROOT)).removesuffix(".py").replace("/", ".")
    for package in ("harness", "problems", "solvers")
    for path in sorted((ROOT / package).rglob("*.py"))
    if ">>> " in path.read_text("utf-8")
]
EXAMPLES = {
    "mortarbench": mb,
    "plot": mb.Answer.plot,
    "problems": problems,
    "reference_solution": reference_solution,
    "solvers": solvers,
    **{
        name: getattr(mb, name)
        for name in (
            "build", "export", "load", "replay", "report", "run", "solve", "suites",
            "test_solver", "validate", "verify",
        )
    },
}  # fmt: skip
#: functions whose examples are slow, since they begin with a run of "smoke"; tests of
#: the command line and of scripts call these functions in every test run
LATER = {"load", "replay", "report", "validate"}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] * (n in LATER)) for n in EXAMPLES]
)
@pytest.mark.usefixtures("blank_figures")
def test_the_examples_of_a_docstring_are_true(name, tmp_path, monkeypatch, capsys):
    """The examples of each docstring run in an empty working directory, so that they
    cannot depend on other docstrings.
    """
    function = EXAMPLES[name]
    monkeypatch.chdir(tmp_path)
    names = {"reference_solution": reference_solution}
    test = doctest.DocTestParser().get_doctest(function.__doc__, names, name, None, 0)

    result = doctest.DocTestRunner().run(test)

    assert result.attempted > 1
    assert result.failed == 0, capsys.readouterr().out


@pytest.mark.parametrize("name", MODULES)
def test_the_examples_of_a_module_are_true(name):
    module = import_module(f"mortarbench.{name}")
    names = {**vars(module), "__name__": "builtins"}  # as in a session
    names.pop("annotations", None)  # doctest would postpone annotations
    result = doctest.testmod(
        module,
        globs=names,
        optionflags=doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE,
    )
    assert result.failed == 0
