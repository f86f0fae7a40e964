"""Timing in this process; test_run.py tests solvers that kill their process."""

import gc
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from mortarbench.harness import QP, Solution, Status, needs_matrices, no_rows
from mortarbench.harness import solution as answers
from mortarbench.harness.operators import SerialisableOperator
from mortarbench.harness.registry import load_plugin
from mortarbench.harness.verify import measure as measuring
from mortarbench.harness.verify.measure import measure
from tests.support import ADVERSARIES

PLUGIN = load_plugin(ADVERSARIES)

#: references to lines of the plug-in in messages, by the code of the line
AT = {
    code: f" ({ADVERSARIES.name}:{line})"
    for line, text in enumerate(ADVERSARIES.read_text().splitlines(), start=1)
    for code in ("raise Va", "sys.exit(3)", "qp.q[:] = 0.0")
    if text.strip().startswith(code)
}


@pytest.fixture
def qp():
    tiny = PLUGIN.problems["tiny"]
    return tiny.build("plain", tiny.defaults, None).qp


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
    ],
)
def test_every_behaviour_of_a_solver_yields_a_status_and_one_line(
    qp, solver, status, message
):
    assert outcome(solver, qp) == (status, message)


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


def test_a_shortened_failure_message_keeps_its_location(qp, tmp_path):
    path = tmp_path / f"{'long' * 50}.py"
    code = ADMM.replace("import helper", "")
    path.write_text(code.replace("helper.fails(q)", "{}['9' * 4000]"))
    message = measure(load_plugin(path).solvers["admm"], qp, 1e-6).solution.message

    assert message.endswith(".py:6)")
    assert len(message) < 2000  # limit of the protocol


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


def test_both_phases_are_timed_and_add_up(qp):
    m = measure(PLUGIN.solvers["honest"], qp, 1e-6).cost

    assert m.prepare_seconds > 0
    assert m.solve_seconds > 0
    assert m.total_seconds == pytest.approx(m.prepare_seconds + m.solve_seconds)
    assert m.inner_loops == 1  # no longer sample was requested


@pytest.mark.parametrize("sample_seconds", [0.0, 0.009, 0.011, 0.1])
def test_repeating_a_short_sample_changes_no_time(qp, monkeypatch, sample_seconds):
    """The clock advances only in the solver: 1 ms in `prepare`, 4 ms in the solve."""
    now = [0.0]
    honest = PLUGIN.solvers["honest"]

    class Moves(type(honest)):
        def prepare(self, qp, tol):
            solve = super().prepare(qp, tol)
            now[0] += 0.001

            def moving():
                now[0] += 0.004
                return solve()

            return moving

    clock = sys.modules["mortarbench.harness.verify.measure"]
    monkeypatch.setattr(clock, "perf_counter", lambda: now[0])
    m = measure(Moves(), qp, 1e-6, sample_seconds=sample_seconds).cost

    assert (m.prepare_seconds, m.solve_seconds) == pytest.approx((0.001, 0.004))
    assert m.total_seconds == pytest.approx(0.005)
    loops = {0.0: 1, 0.009: 1, 0.011: 3, 0.1: 20}[sample_seconds]
    assert m.inner_loops == loops
    assert now[0] == pytest.approx(0.005 * (1 + loops if loops > 1 else 1))


def test_each_phase_has_a_separate_memory_peak(qp):
    """Memory allocated and freed by `prepare` does not count towards the solve."""
    honest = PLUGIN.solvers["honest"]

    class Hungry(type(honest)):
        def prepare(self, qp, tol):
            np.ones(2**24)  # 128 MiB
            return super().prepare(qp, tol)

    m = measure(Hungry(), qp, 1e-6).cost

    assert m.prepare_peak_mib > m.solve_peak_mib + 100
    assert m.peak_mib == m.prepare_peak_mib


def test_the_peak_excludes_earlier_measurements(qp):
    class Hungry(type(PLUGIN.solvers["honest"])):
        def act(self, qp):
            np.ones(2**24)  # 128 MiB
            return super().act(qp)

    modest = PLUGIN.solvers["honest"]
    before = measure(modest, qp, 1e-6).cost.peak_mib
    hungry = measure(Hungry(), qp, 1e-6).cost.peak_mib
    after = measure(modest, qp, 1e-6).cost.peak_mib

    assert before + 100 < hungry < before + 300
    assert after < before + 50


def test_numpy_integers_become_python_integers(qp):
    s = measure(PLUGIN.solvers["numpyscalars"], qp, 1e-6).solution

    assert s.status is Status.SOLVED
    assert type(s.iterations) is int
    assert type(s.counts["products"]) is int


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
    assert message.startswith("ValueError: gc is False (test_measure.py:")
    assert gc.isenabled()


def test_every_repeat_receives_an_equal_copy_of_the_qp(qp, monkeypatch):
    monkeypatch.setattr(measuring, "_inner", lambda *_: 3)
    seen = []

    class Sees(type(PLUGIN.solvers["honest"])):
        def prepare(self, qp, tol):
            seen.append(qp)
            return super().prepare(qp, tol)

    measure(Sees(), qp, 1e-6, sample_seconds=1.0)

    for part in ("P", "q", "A", "b", "G", "h", "lb", "ub"):
        assert len({id(getattr(qp, part)) for qp in seen}) == 4, part
    assert len({id(qp.P.data) for qp in seen}) == 4
    for other in seen:
        assert (other.P - qp.P).nnz == (other.G - qp.G).nnz == 0
        assert np.array_equal(other.q, qp.q)
        assert not other.q.flags.writeable


def test_the_time_of_declines_is_measured(qp, monkeypatch):
    asked = []
    clock = iter(range(100))

    class Asks(type(PLUGIN.solvers["honest"])):
        def declines(self, qp):
            asked.append(next(clock))

    monkeypatch.setattr(measuring, "perf_counter", lambda: next(clock))
    m = measure(Asks(), qp, 1e-6).cost

    assert asked == [1]  # the clock was read once before
    # the clock advances at each reading and at each call of `declines`
    assert m.prepare_seconds == 2


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


def test_an_operator_that_exceeds_memory_is_not_assembled(by_products, monkeypatch):
    monkeypatch.setattr(measuring, "too_large", lambda *_: True)
    s = measure(ReadsEntries(), by_products, 1e-6).solution

    assert s.status is Status.DECLINED


@pytest.mark.parametrize(
    ("iterations", "shown"),
    [
        (-1, "-1"),
        (2**53 + 1, "9007199254740993"),
        (10**300, "a number far outside this range"),
        (-(10**300), "a number far outside this range"),
    ],
)
def test_an_impossible_count_is_refused_and_shown_if_short(qp, iterations, shown):
    class Counts(type(PLUGIN.solvers["honest"])):
        def act(self, qp):
            return replace(super().act(qp), iterations=iterations)

    s = measure(Counts(), qp, 1e-6).solution

    assert s.status is Status.FAILED
    assert s.message == (
        f"malformed Solution: iterations = {shown}, expected 0 to 2**53"
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
