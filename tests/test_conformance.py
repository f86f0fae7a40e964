"""Conformance: every solver passes every check; every check catches its fault."""

import gc
import json
import os
import signal
import time
from dataclasses import dataclass, replace

import numpy as np
import pytest

from harness import Solution, Status, examine, kkt_residuals
from harness.conformance import CHECKS, Grade, run_check
from harness.planted import SHAPES, planted
from solvers import SOLVERS

#: backends that stand for the wildcard entries of the registry; the others are slow
BACKENDS = {
    "qpsolvers:*": ("clarabel", "highs", "quadprog", "sip"),
    "cvxpy:*": ("CLARABEL", "HIGHS"),
}
OTHERS = {
    "qpsolvers:*": ("cvxopt", "daqp", "osqp", "piqp", "proxqp", "qpalm", "qtqp", "scs"),
    "cvxpy:*": ("DAQP", "OSQP", "PIQP", "PROXQP", "QOCO", "QPALM", "SCS"),
}


#: variants of a solver that stands for them
VARIANTS = ("proxqp-dense", "proxqp-sparse", "piqp-dense", "piqp-sparse", "scs-qdldl")


def configured(backends):
    return {
        wildcard.replace("*", backend): replace(SOLVERS[wildcard], backend=backend)
        for wildcard, names in backends.items()
        for backend in names
    }


NATIVE = {name: s for name, s in SOLVERS.items() if name not in BACKENDS}
SLOW = {name: NATIVE.pop(name) for name in VARIANTS} | configured(OTHERS)
CONCRETE = NATIVE | configured(BACKENDS)


@pytest.fixture(autouse=True, scope="module")
def loaded_once():
    """Keep what libraries load out of the collection before every measurement."""
    import cvxpy  # noqa: F401
    import qpsolvers  # noqa: F401

    gc.collect()
    gc.freeze()
    yield
    gc.unfreeze()


@pytest.mark.parametrize("dense", [False, True], ids=["sparse", "dense"])
@pytest.mark.parametrize("shape", SHAPES)
def test_a_planted_point_is_a_solution(shape, dense):
    qp, expected = planted(shape, seed=314159, dense=dense)
    assert kkt_residuals(qp, expected).worst < 1e-13


@pytest.mark.parametrize("check", CHECKS)
@pytest.mark.parametrize("name", CONCRETE)
def test_a_solver_conforms(name, check):
    grade, message = run_check(check, CONCRETE[name])
    if grade is Grade.DECLINE:
        pytest.skip(message)
    assert grade is Grade.PASS, message


@pytest.mark.slow
@pytest.mark.parametrize("check", CHECKS)
@pytest.mark.parametrize("name", SLOW)
def test_variants_and_other_backends_conform(name, check):
    grade, message = run_check(check, SLOW[name])
    assert grade is not Grade.FAIL, message


@dataclass(frozen=True)
class Sound:
    """PIQP in disguise, for others to spoil."""

    spoilt: str = ""

    def declines(self, qp):
        return SOLVERS["piqp"].declines(qp)

    def prepare(self, qp, tol):
        return lambda: self.act(qp, tol)

    def act(self, qp, tol):
        return self.honest(qp, tol)

    def honest(self, qp, tol):
        return SOLVERS["piqp"].prepare(qp, tol)()


class StopsEarly(Sound):
    def act(self, qp, tol):
        return self.honest(qp, 0.1)


class FlipsSigns(Sound):
    def act(self, qp, tol):
        s = self.honest(qp, tol)
        return replace(s, y=-s.y)


class LeavesRoundOff(Sound):
    def act(self, qp, tol):
        s = self.honest(qp, tol)
        return replace(s, z_box=s.z_box - 1e-16)


class Remembers(Sound):
    def act(self, qp, tol):
        s = self.honest(qp, tol)
        first = not MEMORY
        MEMORY.append(s)
        return s if first else replace(s, iterations=1)


MEMORY = []


class Wanders(Sound):
    def act(self, qp, tol):
        s = self.honest(qp, tol)
        return replace(s, x=s.x + 1e-9 * np.random.default_rng().standard_normal())


class Scales(Sound):
    """Answers rightly, after scaling the data in place by force."""

    def act(self, qp, tol):
        s = self.honest(qp, tol)
        qp.q.flags.writeable = True
        qp.q[:] *= 2
        return s


class TakesAnything(Sound):
    def __init__(self, **options):
        pass


class AlwaysSolved(Sound):
    def act(self, qp, tol):
        s = self.honest(qp, tol)
        return replace(s, status=Status.SOLVED, x=np.nan_to_num(s.x))


class Silent(Sound):
    def act(self, qp, tol):
        return replace(self.honest(qp, tol), message="")


class TakesOperatorsForZero(Sound):
    def declines(self, qp):
        return None

    def act(self, qp, tol):
        if qp.is_explicit:
            return self.honest(qp, tol)
        zero = np.zeros(qp.q.size)
        return Solution(
            status=Status.SOLVED, x=np.clip(zero, qp.lb, qp.ub), y=qp.b, z=qp.h,
            z_box=zero,
        )  # fmt: skip


class StopsAtTheStart(Sound):
    """As HiGHS 1.15.1 did on QPs with bounds only."""

    def act(self, qp, tol):
        s = self.honest(qp, tol)
        return replace(s, x=qp.lb) if qp.q.size == 400 else s


class Slow(Sound):
    def act(self, qp, tol):
        time.sleep(0.1)
        return self.honest(qp, tol)


class RepeatsTheFirst(Sound):
    def chain(self, tol):
        prepare = SOLVERS["piqp"].chain(tol)
        first = []

        def next_one(qp):
            first.append(prepare(qp))
            return first[0]

        return next_one


class DeclinesAll(Sound):
    def declines(self, qp):
        return "never on a Monday"


class Dies(Sound):
    def act(self, qp, tol):
        os.kill(os.getpid(), signal.SIGSEGV)


PLUGIN_SOLVERS = {"sound": Sound(), "dies": Dies(), "declines": DeclinesAll()}


@pytest.mark.parametrize("check", CHECKS)
def test_a_sound_solver_fails_no_check(check):
    grade, message = run_check(check, Sound())
    assert grade is not Grade.FAIL, message


@pytest.mark.parametrize(
    ("kind", "check"),
    [
        (StopsEarly, "finds the planted solution: everything, sparse"),
        (StopsEarly, "reaches the tolerance 1e-06: box"),
        (FlipsSigns, "gives multipliers our signs"),
        (LeavesRoundOff, "puts none on absent bounds"),
        (Remembers, "starts every repeat cold, same answer"),
        (Wanders, "starts every repeat cold, same answer"),
        (Scales, "leaves the problem alone: sparse"),
        (Scales, "leaves the problem alone: dense"),
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


def test_more_cpu_time_than_passes_is_more_than_one_thread(monkeypatch):
    # a fake clock: real threads need idle cores to show
    monkeypatch.setattr(time, "process_time", lambda: 2 * time.perf_counter())
    slow = Slow()
    assert run_check("computes in one thread", slow).grade is Grade.FAIL
    monkeypatch.undo()
    assert run_check("computes in one thread", slow).grade is Grade.PASS


def test_a_decline_of_all_is_no_pass():
    grades = {run_check(check, DeclinesAll()).grade for check in CHECKS}
    assert Grade.PASS in grades  # its options
    result = run_check("gives multipliers our signs", DeclinesAll())
    assert result == (Grade.DECLINE, "never on a Monday")


@pytest.fixture
def plugin(tmp_path):
    """This file's solvers, offered as a plug-in."""
    path = tmp_path / "spoilt.py"
    here = os.path.abspath(__file__)
    path.write_text(
        "import importlib.util, sys\n"
        f"spec = importlib.util.spec_from_file_location('conformance', {here!r})\n"
        "module = importlib.util.module_from_spec(spec)\n"
        "sys.modules['conformance'] = module\n"
        "spec.loader.exec_module(module)\n"
        "SOLVERS = module.PLUGIN_SOLVERS\n"
    )
    return path


def command(*arguments):
    from harness.__main__ import main

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sys.argv", ["mortarbench", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
    return ended.value.code


def test_the_command_says_how_every_check_ended(plugin, capsys):
    assert command("test-solver", "sound", "--plugin", plugin, "--json") == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["check"] for row in rows] == list(CHECKS)
    assert {row["grade"] for row in rows} == {"pass", "decline"}


def test_a_crash_fails_its_checks_and_no_more(plugin, capsys, monkeypatch):
    few = ("gives multipliers our signs", "refuses a misspelt option")
    monkeypatch.setattr(examine, "CHECKS", few)
    assert command("test-solver", "dies", "--plugin", plugin) == 1
    lines = capsys.readouterr().out.splitlines()
    (options,) = (line for line in lines if "misspelt option" in line)
    assert options.startswith("pass")
    (signs,) = (line for line in lines if "our signs" in line)
    assert signs.startswith("fail")
    assert "SIGSEGV" in signs


def test_a_solver_that_solves_nothing_does_not_conform(plugin, capsys):
    assert command("test-solver", "declines", "--plugin", plugin) == 1
    assert "never on a Monday" in capsys.readouterr().out


def test_an_unknown_solver_is_wrong_input(capsys):
    assert command("test-solver", "nobody") == 2
    assert "nobody" in capsys.readouterr().err
