"""Timing in this process; test_run.py tests solvers that kill their process."""

import gc
import os
import subprocess
import sys
from dataclasses import dataclass, field, replace
from math import ceil
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.sparse import csc_array

from mortarbench.harness import QP, Solution, Status, needs_matrices, no_rows
from mortarbench.harness import solution as answers
from mortarbench.harness.operators import SerialisableOperator
from mortarbench.harness.registry import load_plugin
from mortarbench.harness.verify import measure as measuring
from mortarbench.harness.verify.measure import measure, perturbed
from tests.support import ADVERSARIES

PLUGIN = load_plugin(ADVERSARIES)

#: references to lines of the plug-in in messages, by the code of the line
AT = {
    code: f" ({ADVERSARIES.name}:{line})"
    for line, text in enumerate(ADVERSARIES.read_text().splitlines(), start=1)
    for code in ("raise Va", "sys.exit(3)", "qp.q[:] = 0.0", "import a_library")
    if text.strip().startswith(code)
}


@pytest.fixture
def qp():
    tiny = PLUGIN.problems["tiny"]
    return tiny.build("plain", None).qp


def cost_of(*measured, **options):
    return SimpleNamespace(**measure(*measured, **options).cost)


def outcome(solver, qp):
    s = measure(PLUGIN.solvers[solver], qp, 1e-6).solution
    return s.status, s.message


@pytest.mark.parametrize(
    ("solver", "status", "message"),
    [
        ("honest", Status.SOLVED, ""),
        (
            "raises",
            Status.FAILED,
            f"ValueError: first line second line{AT['raise Va']}",
        ),
        ("exits", Status.FAILED, f"SystemExit: 3{AT['sys.exit(3)']}"),
        (
            "mutates",
            Status.FAILED,
            f"ValueError: assignment destination is read-only{AT['qp.q[:] = 0.0']}",
        ),
        ("declines", Status.DECLINED, "never on a Monday"),
        ("returnsnone", Status.FAILED, "returned NoneType, expected Solution"),
        ("wrongshape", Status.FAILED, "Solution.x has shape (3,), expected (2,)"),
        (
            "lacks",
            Status.DECLINED,
            "not installed: a_library_nobody_has (pip install a_library_nobody_has)",
        ),
        (
            "lacksundeclared",
            Status.FAILED,
            "ModuleNotFoundError: No module named 'a_library_nobody_has'"
            f"{AT['import a_library']}",
        ),
    ],
)
def test_every_behaviour_of_a_solver_yields_a_status_and_one_line(
    qp, solver, status, message
):
    assert outcome(solver, qp) == (status, message)


def test_an_import_error_of_an_installed_package_is_a_failure(qp):
    status, message = outcome("breaks", qp)
    assert status is Status.FAILED
    assert "no_such_function" in message


HELPER = """
def fails(x):
    return x.nothing
"""
ADMM = """
from dataclasses import dataclass
import helper

def start(q):
    return helper.fails(q)

@dataclass(frozen=True)
class Admm:
    rho: float = 1.0

    def declines(self, qp):
        return None

    def prepare(self, qp, tol):
        def solve():
            return start(
                qp.q
            )
        return solve

@dataclass(frozen=True)
class Faster(Admm):
    rho: float = 10.0

SOLVERS = {"admm": Admm(), "faster": Faster()}
"""


@pytest.mark.parametrize("name", ["admm", "faster"])
def test_a_failure_ends_with_the_last_place_in_the_solver_s_own_file(
    qp, tmp_path, name
):
    """The message names no helper, no NumPy file and no folder."""
    (tmp_path / "helper.py").write_text(HELPER)
    (tmp_path / "admm.py").write_text(ADMM)
    solver = load_plugin(tmp_path / "admm.py").solvers[name]

    assert measure(solver, qp, 1e-6).solution.message == (
        "AttributeError: 'numpy.ndarray' object has no attribute 'nothing' (admm.py:6)"
    )


@pytest.mark.parametrize(
    ("reason", "got"),
    [
        (False, "False"),
        (True, "True"),
        (0, "0"),
        (("no",), "tuple"),
        (object(), "object"),
    ],
)
def test_declines_must_return_none_or_text(qp, reason, got):
    class Vague(type(PLUGIN.solvers["honest"])):
        def declines(self, qp):
            return reason

    s = measure(Vague(), qp, 1e-6).solution

    assert s.status is Status.FAILED
    assert s.message == f"declines returned {got}; expected None or a string"


class Clock:
    """Clock that advances only when a solver calls `work`."""

    def __init__(self, monkeypatch):
        self.now = 0.0
        monkeypatch.setattr(measuring, "perf_counter", lambda: self.now)

    def work(self, seconds):
        self.now += seconds


@pytest.fixture
def clock(monkeypatch):
    return Clock(monkeypatch)


@dataclass
class Box:
    """Exact solver of min ½‖x‖² + qᵀx over a box.

    `known` is called with the QP and a function that computes the answer; by default,
    it calls this function.
    """

    clock: Clock
    seconds: float = 0.004
    first: float = 0.0  #: additional time of the first solve, s
    prepare_share: float = 0.25
    known: object = None
    calls: list = field(default_factory=list)

    def declines(self, qp):
        return None

    def prepare(self, qp, tol):
        self.calls.append(qp)
        if self.known is not None:
            return lambda: self.known(qp, lambda: self.solve(qp, 1.0))
        self.clock.work(self.prepare_share * self.seconds)
        return lambda: self.solve(qp, 1 - self.prepare_share)

    def solve(self, qp, share):
        self.clock.work(share * self.seconds + self.first * (len(self.calls) == 1))
        d = qp.P.diagonal()
        x = np.clip(-qp.q / d, qp.lb, qp.ub)
        return Solution(
            status=Status.SOLVED, x=x, y=np.zeros(0), z=np.zeros(0),
            z_box=-(d * x + qp.q),
        )  # fmt: skip


@pytest.fixture
def box():
    """Return min ½‖x‖² − 4x₁ + 3x₂ over [0, 1]², with the solution x = (1, 0)."""
    return QP(
        P=csc_array(np.eye(2)), q=np.array([-4.0, 3.0]), A=no_rows(2), b=np.zeros(0),
        G=no_rows(2), h=np.zeros(0), lb=np.zeros(2), ub=np.ones(2),
    )  # fmt: skip


@pytest.mark.parametrize(
    "seconds", [1e-4, 1e-3, 0.0024, 0.0026, 0.004, 0.006, 0.9, 1.1, 60.0]
)
def test_one_rule_determines_all_times(box, clock, seconds):
    """Timed solves take 5 ms in total; each follows a solve of another QP."""
    solver = Box(clock, seconds)
    m = cost_of(solver, box, 1e-6)

    assert m.prepare_seconds == pytest.approx(0.25 * seconds)
    assert m.solve_seconds == pytest.approx(0.75 * seconds)
    assert m.total_seconds == pytest.approx(seconds)
    if seconds > 1:
        assert (m.inner, m.untimed, m.remembered) == (1, 0, None)
        assert len(solver.calls) == 1
    else:
        timed = ceil(0.005 / seconds - 1e-9)
        assert (m.inner, m.untimed) == (timed, 1 + timed)
        assert m.remembered is False
        same = [np.array_equal(qp.q, box.q) for qp in solver.calls]
        assert same == [True, *[False, True] * timed]


@pytest.mark.parametrize("first", [0.02, 0.9])
def test_the_time_of_a_slow_first_solve_is_not_recorded(box, clock, first):
    """The first solve may compile code, for each shape as in JAX."""
    m = cost_of(Box(clock, 0.001, first=first), box, 1e-6)

    assert m.total_seconds == pytest.approx(0.001)
    assert m.remembered is False


def keyed(key):
    """Return a function that solves each QP with a new key once."""
    answers = {}

    def known(qp, solve):
        if key(qp) not in answers:
            answers[key(qp)] = solve()
        return answers[key(qp)]

    return known


KEYS = {
    "content": lambda qp: (qp.q.tobytes(), qp.P.data.tobytes()),
    "content of q": lambda qp: qp.q.tobytes(),
    "content of P": lambda qp: qp.P.data.tobytes(),
    "shape": lambda qp: (qp.P.shape, qp.P.nnz),
    "address of q": lambda qp: qp.q.ctypes.data,
}


@pytest.mark.parametrize("seconds", [1e-4, 0.002, 0.02, 0.9])
@pytest.mark.parametrize("key", KEYS)
def test_a_solver_that_remembers_answers_is_marked(box, clock, key, seconds):
    m = cost_of(Box(clock, seconds, known=keyed(KEYS[key])), box, 1e-6)

    assert m.remembered is True
    assert clock.now <= 0.01 + 12 * seconds  # evidence is not collected at length


def test_a_single_delayed_solve_does_not_mark_a_solver(box, clock):
    """Another program may delay one solve of a perturbed QP."""

    def delayed(qp, solve):
        clock.work(0.5 * (len(solver.calls) == 2))
        return solve()

    solver = Box(clock, 0.02, known=delayed)
    m = cost_of(solver, box, 1e-6)

    assert m.remembered is False
    assert len(solver.calls) == 4  # one more solve of a perturbed QP decides


@pytest.mark.parametrize("fault", ["raises", "fails", "declines"])
def test_faults_on_other_qps_do_not_affect_the_answer(box, clock, fault):
    class Faulty(Box):
        def declines(self, qp):
            other = not np.array_equal(qp.q, box.q)
            return "no" if other and fault == "declines" else None

        def solve(self, qp, share):
            s = super().solve(qp, share)
            if np.array_equal(qp.q, box.q):
                return s
            if fault == "raises":
                raise ZeroDivisionError
            return replace(s, status=Status.FAILED)

    t = measure(Faulty(clock, 0.001), box, 1e-6)

    assert t.solution.status is Status.SOLVED
    assert t.solution.x.tolist() == [1, 0]
    assert (t.cost["inner"], t.cost["remembered"]) == (5, None)
    assert t.cost["total_seconds"] == pytest.approx(0.001)


def test_the_solution_of_a_perturbed_qp_is_known(box):
    """The objective is scaled by f and 1/f, so that x is clipped at f²·(−q)."""
    q = np.array([-0.5, 3.0])
    factors = set()
    for number in range(1, 100):
        other = perturbed(replace(box, q=q), number)
        f = other.q[0] / q[0]
        factors.add(f)
        assert 1.01 <= f <= 1.02
        assert other.q == pytest.approx(f * q)
        assert other.P.toarray() == pytest.approx(np.eye(2) / f)
        assert not other.q.flags.writeable
        assert not other.P.data.flags.writeable
        for name in ("A", "b", "G", "h", "lb", "ub"):
            old, new = getattr(box, name), getattr(other, name)
            assert np.array_equal(*(getattr(M, "data", M) for M in (old, new)))
    assert len(factors) == 99


def test_only_q_is_perturbed_if_p_is_an_operator(by_products):
    other = perturbed(by_products, 1)
    assert other.P is by_products.P
    assert other.q == pytest.approx(other.q[0] * np.ones(3))
    assert cost_of(ReadsEntries(), by_products, 1e-6).remembered is False


def test_a_step_of_a_sequence_is_solved_once(box, clock):
    solver = Box(clock, 0.001)
    m = cost_of(solver, box, 1e-6, prepare=lambda qp: solver.prepare(qp, 1e-6))

    assert (m.inner, m.untimed, m.remembered) == (1, 0, None)
    assert len(solver.calls) == 1


def test_a_child_that_returns_from_a_solve_does_not_continue(box, tmp_path):
    class Forks(Box):
        def solve(self, qp, share):
            os.fork()
            return super().solve(qp, share)

    class Still:
        def work(self, seconds):
            pass

    parent = os.getpid()
    measure(Forks(Still()), box, 1e-6, once=True)
    (tmp_path / str(os.getpid())).touch()

    assert os.getpid() == parent
    assert [path.name for path in tmp_path.iterdir()] == [str(parent)]


def test_the_memory_peak_includes_freed_memory_of_the_preparation(qp):
    honest = PLUGIN.solvers["honest"]

    class Hungry(type(honest)):
        def prepare(self, qp, tol):
            np.ones(2**24)  # 128 MiB
            return super().prepare(qp, tol)

    peaks = [cost_of(solver, qp, 1e-6).peak_mib for solver in (Hungry(), honest)]

    assert peaks[0] > peaks[1] + 100


class UnspeakableError(Exception):
    def __str__(self):
        raise RuntimeError("cannot be shown")


class Unreadable:
    """Array that raises an exception without a readable text when it is read."""

    @property
    def shape(self):
        raise UnspeakableError

    def __array__(self, *_, **__):
        raise UnspeakableError


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"iterations": -5}, "iterations = -5, expected 0 to"),
        ({"counts": {"products": 10**400}}, "expected 0 to"),
        ({"x": np.array(["1", "0"])}, "x has dtype <U1, expected real numbers"),
        ({"x": np.array([1 + 1j, 0])}, "x has dtype complex128, expected real numbers"),
        (
            {"x": np.array([1.0, 0.0], dtype=object)},
            "x has dtype object, expected real numbers",
        ),
        ({"x": Unreadable()}, "malformed Solution: (it cannot be shown)"),
    ],
)
def test_a_malformed_answer_is_a_failure_with_a_short_message(qp, wrong, message):
    class Malformed(type(PLUGIN.solvers["honest"])):
        def act(self, qp):
            return replace(super().act(qp), **wrong)

    s = measure(Malformed(), qp, 1e-6).solution

    assert s.status is Status.FAILED
    assert message in s.message
    assert len(s.message) < 500


def test_a_history_that_would_fill_the_disk_is_dropped_and_the_answer_kept(
    qp, monkeypatch
):
    monkeypatch.setattr(answers, "MAX_HISTORY_BYTES", 100)

    class Verbose(type(PLUGIN.solvers["honest"])):
        def act(self, qp):
            return replace(super().act(qp), history={"k": np.arange(20)})

    s = measure(Verbose(), qp, 1e-6).solution

    assert s.status is Status.SOLVED
    assert s.history == {}
    assert s.message == "history dropped: it has 160 bytes, expected at most 100"


def test_garbage_collection_is_off_during_timed_phases(qp):
    class Looks(type(PLUGIN.solvers["honest"])):
        def act(self, qp):
            raise ValueError(f"gc is {gc.isenabled()}")

    message = measure(Looks(), qp, 1e-6).solution.message
    assert message.startswith("ValueError: gc is False (")
    assert gc.isenabled()


def test_every_timed_solve_receives_a_new_copy_of_the_qp(qp, clock):
    seen = []

    class Sees(type(PLUGIN.solvers["honest"])):
        def prepare(self, qp, tol):
            seen.append(qp)
            clock.work(0.001)
            return super().prepare(qp, tol)

    measure(Sees(), qp, 1e-6)
    first, _, *others = seen

    assert len(others) == 5
    for part in ("P", "q", "A", "b", "G", "h", "lb", "ub"):
        assert len({id(getattr(qp, part)) for qp in seen}) == len(seen), part
    assert len({id(qp.P.data) for qp in seen}) == len(seen)
    for other in others:
        assert (other.P - first.P).nnz == (other.G - first.G).nnz == 0
        assert np.array_equal(other.q, first.q)
        assert not other.q.flags.writeable


class ReadsEntries:
    """Solver that computes x from the entries of P."""

    def declines(self, qp):
        return needs_matrices(qp)

    def prepare(self, qp, tol):
        x = np.linalg.solve(qp.P, -qp.q)
        return lambda: Solution(
            status=Status.SOLVED, x=x, y=np.zeros(0), z=np.zeros(0),
            z_box=np.zeros(qp.q.size),
        )  # fmt: skip


@pytest.fixture
def by_products():
    """Return the QP min ½xᵀPx − Σxᵢ with P = diag(1, 2, 4) as an operator."""
    free = np.full(3, np.inf)
    makers = {"matrix": lambda arrays: lambda x: arrays["P"] @ x}
    arrays = {"P": np.diag([1.0, 2.0, 4.0])}
    return QP(
        P=SerialisableOperator(3, "matrix", arrays, makers),
        q=-np.ones(3), A=no_rows(3), b=np.zeros(0), G=no_rows(3), h=np.zeros(0),
        lb=-free, ub=free,
    )  # fmt: skip


def test_a_small_operator_is_assembled_for_solvers_that_need_entries(by_products):
    s = measure(ReadsEntries(), by_products, 1e-6).solution

    assert s.status is Status.SOLVED
    assert s.x == pytest.approx([1, 1 / 2, 1 / 4])


def test_a_large_operator_is_not_assembled(by_products, monkeypatch):
    monkeypatch.setattr(measuring, "MAX_ASSEMBLED_ROWS", 2)
    s = measure(ReadsEntries(), by_products, 1e-6).solution

    assert s.status is Status.DECLINED
    assert s.message == (
        "needs explicit matrices; P is an operator with 3 rows; operators are "
        "assembled up to 2 rows, if memory allows"
    )


def test_processes_of_runs_import_no_unused_modules():
    """Processes start tens of times in a run, so imports such as `scipy.stats` are
    costly.
    """
    needless = {
        "scipy.stats", "scipy.optimize", "scipy.integrate", "scipy.spatial",
        "matplotlib", "pandas", "pyarrow", "distributed", "rich",
    }  # fmt: skip
    program = "import sys, mortarbench.__main__; print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-P", "-c", program],
        capture_output=True,
        text=True,
        check=True,
    )

    assert needless & set(done.stdout.split()) == set()
