"""Conformance checks: solvers fail no check, and each check detects its fault."""

import gc
import json
import re
from dataclasses import replace

import numpy as np
import pytest

from mortarbench.harness.conformance import conformance
from mortarbench.harness.conformance.conformance import (
    CHECKS,
    INVARIANCE_PREFIX,
    Grade,
    run_check,
)
from mortarbench.harness.verify import measure
from mortarbench.solvers import SOLVERS
from tests.support import FAULTY_SOLVERS, faulty_solvers
from tests.support.faulty_solvers import (
    MEMORIES,
    MEMORY,
    AlwaysSolved,
    CachesByAddress,
    CachesByContent,
    CachesByShape,
    CachesThePreparation,
    Compiles,
    CompilesOnce,
    DeclinesAll,
    FlipsSigns,
    MindsTheOrder,
    MindsUnits,
    Raises,
    Remembers,
    RepeatsTheFirst,
    ReusesPatterns,
    Silent,
    Sound,
    StopsAtTheStart,
    StopsEarly,
    TakesAnything,
    TakesOperatorsForZero,
    Wanders,
)

pytestmark = pytest.mark.together  # all tests use the imported libraries
#: backends that represent the wildcard entries of the registry
BACKENDS = {
    "qpsolvers:*": ("clarabel", "highs", "quadprog", "sip"),
    "cvxpy:*": ("CLARABEL", "HIGHS"),
}
OTHERS = {
    "qpsolvers:*": ("cvxopt", "daqp", "osqp", "piqp", "proxqp", "qpalm", "qtqp", "scs"),
    "cvxpy:*": ("DAQP", "OSQP", "PIQP", "PROXQP", "QOCO", "QPALM", "SCS"),
}


#: variants, each represented by another solver
VARIANTS = ("proxqp-dense", "proxqp-sparse", "piqp-dense", "piqp-sparse", "scs-qdldl")


def configured(backends):
    return {
        wildcard.replace("*", backend): replace(SOLVERS[wildcard], backend=backend)
        for wildcard, names in backends.items()
        for backend in names
    }


NATIVE = {name: s for name, s in SOLVERS.items() if name not in BACKENDS}
CONCRETE = NATIVE | configured(BACKENDS)
ALL = CONCRETE | configured(OTHERS) | {"sound": Sound()}
#: checks of conformance, without equivalent formulations, which have a separate test
STRICT = [check for check in CHECKS if not check.startswith(INVARIANCE_PREFIX)]
INVARIANT = [check for check in CHECKS if check.startswith(INVARIANCE_PREFIX)]


@pytest.fixture(autouse=True, scope="module")
def loaded_once():
    """Exclude loaded libraries from the garbage collection before every measurement."""
    import cvxpy  # noqa: F401
    import qpsolvers  # noqa: F401

    gc.collect()
    gc.freeze()


OPTIONS = "refuses a misspelt option"
#: one solver for each type of constraints that our solvers accept, one adapter of a
#: single library, and one backend of each adapter of several libraries
REPRESENTATIVES = {
    "smalbe", "pdas", "nsgs", "clarabel", "qpsolvers:quadprog",
    "cvxpy:HIGHS",
}  # fmt: skip
#: checks of the other solvers in default runs
FOR_ALL = {
    "finds the planted solution: bounds",
    "finds the planted solution: everything",
    "gives multipliers our signs",
    OPTIONS,
    "claims no success: infeasible",
    "takes or declines an operator",
}
#: checks in which a solver takes seconds to reach its iteration limit
LONG = {
    ("nsgs", "finds where a membrane of 400 nodes touches"),
    ("nsgs", "claims no success: unbounded"),
}


def test_representatives_and_their_checks_exist():
    assert REPRESENTATIVES <= CONCRETE.keys()
    assert set(STRICT) >= FOR_ALL


@pytest.mark.parametrize(
    ("name", "check"),
    [
        (name, check)
        for name in CONCRETE
        for check in STRICT
        if name in REPRESENTATIVES or (check in FOR_ALL and name not in VARIANTS)
        if (name, check) not in LONG
    ],
)
def test_a_solver_conforms(name, check):
    grade, message = run_check(check, CONCRETE[name])
    if grade is Grade.DECLINE:
        pytest.skip(message)
    assert grade is Grade.PASS, message


@pytest.mark.slow
@pytest.mark.parametrize("name", ALL)
def test_every_solver_passes_or_declines_every_check(name):
    results = {check: run_check(check, ALL[name]) for check in STRICT}
    failed = {c: r.message for c, r in results.items() if r.grade is Grade.FAIL}
    assert failed == {}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(n, marks=() if n in ("smalbe", "pdas") else pytest.mark.slow)
        for n in NATIVE
        if n.startswith(("smalbe", "pdas", "projected-gradient"))
    ],
)
def test_smalbe_pdas_and_projected_gradient_have_no_weakness(name):
    grades = {run_check(check, NATIVE[name]).grade for check in INVARIANT}
    assert Grade.PASS in grades
    assert grades <= {Grade.PASS, Grade.DECLINE}


@pytest.mark.parametrize(
    ("kind", "check"),
    [
        (StopsEarly, "finds the planted solution: everything"),
        (StopsEarly, "reaches the tolerance: bounds"),
        (FlipsSigns, "gives multipliers our signs"),
        (Remembers, "starts every repeat cold, same answer"),
        (Wanders, "starts every repeat cold, same answer"),
        (TakesAnything, "refuses a misspelt option"),
        (AlwaysSolved, "claims no success: infeasible"),
        (AlwaysSolved, "claims no success: unbounded"),
        (Silent, "claims no success: unbounded"),
        (TakesOperatorsForZero, "takes or declines an operator"),
        (StopsAtTheStart, "finds where a membrane of 400 nodes touches"),
        (RepeatsTheFirst, "solves a sequence"),
    ],
)
def test_a_check_catches_its_fault(kind, check):
    MEMORY.clear()
    assert run_check(check, kind()).grade is Grade.FAIL


@pytest.fixture
def clock(monkeypatch):
    """Let solves take 10 ms, and further work the requested time, on any machine."""
    now = [0.0]

    def work(seconds):
        now[0] += seconds or 0.01

    monkeypatch.setattr(faulty_solvers, "work", work)
    monkeypatch.setattr(measure, "perf_counter", lambda: now[0])


@pytest.mark.parametrize(
    "kind", [CachesByContent, CachesByShape, CachesByAddress, CachesThePreparation]
)
@pytest.mark.usefixtures("clock")
def test_a_solver_that_remembers_answers_is_named(kind):
    MEMORIES.clear()
    result = run_check("remembers no answer", kind())
    assert result.grade is Grade.FAIL
    assert "expected no results of earlier solves" in result.message


@pytest.mark.parametrize("kind", [Sound, Compiles, CompilesOnce, ReusesPatterns])
@pytest.mark.usefixtures("clock")
def test_a_slow_first_call_is_not_accused(kind):
    MEMORIES.clear()
    grade, message = run_check("remembers no answer", kind())
    assert grade is Grade.PASS, message


@pytest.mark.parametrize("check", [c for c in CHECKS if c != OPTIONS])
def test_an_exception_is_a_failure(check):
    grade, message = run_check(check, Raises())
    if check.startswith("solves over") or "sequence" in check:
        assert grade is Grade.DECLINE  # no discs, cones or chain()
    else:
        assert grade is Grade.FAIL
        assert re.search(r"ValueError: not today \(faulty_solvers\.py:\d+\)", message)


@pytest.mark.parametrize(
    ("kind", "check"),
    [
        (MindsUnits, "keeps its answer: everything, units N, m"),
        (MindsTheOrder, "keeps its answer: bounds, unknowns permuted"),
    ],
)
def test_a_change_by_an_equivalent_formulation_is_a_weakness(kind, check):
    assert run_check(check, Sound()).grade is Grade.PASS
    assert run_check(check, kind()).grade is Grade.WEAK


def test_declining_everything_is_not_a_pass():
    kinds = {check.partition(":")[0]: check for check in CHECKS}
    grades = {run_check(check, DeclinesAll()).grade for check in kinds.values()}
    assert Grade.PASS in grades  # the check of options
    result = run_check("gives multipliers our signs", DeclinesAll())
    assert result == (Grade.DECLINE, "never on a Monday")


def command(*arguments):
    from mortarbench.__main__ import main

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["mortarbench", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
    return ended.value.code


def test_weaknesses_and_failures_are_listed_in_markdown(capsys, monkeypatch):
    units = "keeps its answer: everything, units N, m"
    few = (units, "refuses a misspelt option", "gives multipliers our signs")
    monkeypatch.setattr(conformance, "CHECKS", few)
    names = ("sound", "minds", "raises")
    assert command("test-solver", *names, "--plugin", FAULTY_SOLVERS, "--markdown") == 1
    lines = capsys.readouterr().out.splitlines()

    minds, raises = (lines.index(f"## {name}") for name in names[1:])
    assert lines[:minds] == ["## sound", ""]
    (weak,) = lines[minds + 2 : raises]
    assert weak.startswith(f"- weak: {units}: claimed solved, but")
    failed = [line.partition(": ValueError")[0] for line in lines[raises + 2 :]]
    assert failed == [f"- fail: {check}" for check in (units, few[2])]


def test_results_of_several_solvers_are_printed_as_json(capsys, monkeypatch):
    few = ("refuses a misspelt option", "keeps its answer: bounds, mirrored")
    monkeypatch.setattr(conformance, "CHECKS", few)
    named = ["piqp-dense", "piqp-sparse", "sound"]
    command("test-solver", *named, "--plugin", FAULTY_SOLVERS, "--json")
    rows = json.loads(capsys.readouterr().out)
    assert [row["solver"] for row in rows] == np.repeat(named, 2).tolist()
    for row in rows[1::2]:
        assert re.fullmatch(r"\d+ iterations, \d+ without the change", row["message"])

    assert command("test-solver", "nobody") == 2
    assert "nobody" in capsys.readouterr().err
    assert command("test-solver", "piqp", "--json", "--markdown") == 2


def test_a_crash_fails_only_the_current_check(capsys, monkeypatch):
    few = ("gives multipliers our signs", "refuses a misspelt option")
    monkeypatch.setattr(conformance, "CHECKS", few)
    assert command("test-solver", "dies", "--plugin", FAULTY_SOLVERS) == 1
    lines = capsys.readouterr().out.splitlines()
    (options,) = (line for line in lines if "misspelt option" in line)
    assert options.startswith("pass")
    (signs,) = (line for line in lines if "our signs" in line)
    assert signs.startswith("fail")
    assert "SIGSEGV" in signs


def test_a_solver_that_solves_nothing_does_not_conform(capsys):
    assert command("test-solver", "declines", "--plugin", FAULTY_SOLVERS) == 1
    assert "never on a Monday" in capsys.readouterr().out


def test_failures_are_reported_with_exit_code_1(capsys, monkeypatch):
    few = [
        "finds the planted solution: bounds", "refuses a misspelt option",
        "gives multipliers our signs",
    ]  # fmt: skip
    monkeypatch.setattr(conformance, "CHECKS", few)
    wrong = "declines returned False; expected None or a string"

    assert command("test-solver", "false", "--plugin", FAULTY_SOLVERS) == 1
    out, err = capsys.readouterr()
    assert out.count(wrong) == 2
    assert "1 pass, 0 decline, 0 weak, 2 fail" in out
    assert err == (
        f"mortarbench: false does not conform: it fails {few[0]!r}, {few[2]!r}\n"
    )

    assert command("test-solver", "declines", "--plugin", FAULTY_SOLVERS, "--json") == 1
    assert capsys.readouterr().err == (
        "mortarbench: declines does not conform: it passes no check "
        "'finds the planted solution': it solved no QP\n"
    )

    assert command("test-solver", "sound", "--plugin", FAULTY_SOLVERS) == 0
    assert capsys.readouterr().err == ""
