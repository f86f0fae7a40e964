"""Plug-in with a family of tiny QPs, a correct solver, and misbehaving solvers.

The QPs are

    min x₁² + ½x₂² − 4x₁ + 3x₂   s.t.   x₁ ≤ h,  x ≥ 0

For h ≤ 2, the solution is x = (h, 0) with multipliers z = 4 − 2h and z_box = (0, −3).

If the module is run as a program with the name of a solver and two file descriptors, it
acts as a worker.
"""

import ctypes
import os
import signal
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
from scipy.sparse import csr_array

from mortarbench.harness import QP, Case, Fields, InputError, Solution, Status, no_rows
from mortarbench.harness.errors import PastEndError
from mortarbench.harness.plugin import About, Family
from mortarbench.harness.processes.cases import Cases
from mortarbench.harness.processes.worker import Worker, serve


@dataclass(frozen=True)
class Tiny(Family):
    forms: ClassVar = ("plain",)

    h: float = 1.0
    fault: str = "none"

    def build(self, form, reference):
        if self.fault == "build":
            raise ZeroDivisionError("no stiffness")
        if self.fault == "input":
            raise InputError("tiny: fault=input is out of range")
        if self.fault == "end":
            raise PastEndError("tiny: there is no further problem")
        if self.fault == "memory":
            raise MemoryError("Unable to allocate 1 PiB")
        if self.fault == "exit":
            sys.exit(3)

        def quantities(s):
            if self.fault == "quantities":
                raise ZeroDivisionError("no quantity")
            return {"first": s.x[0], "all": s.x, "number": np.int64(2)}

        def fields(s):
            if self.fault == "fields":
                raise ZeroDivisionError("no field")
            square = np.array([[0.0, 0], [1, 0], [1, 1], [0, 1]])
            return Fields(
                points=square, cells=np.arange(4)[None], bodies=np.zeros(1, int),
                displacement=square * s.x[0],
            )  # fmt: skip

        qp = QP(
            P=csr_array(np.diag([2.0, 1.0])), q=np.array([-4.0, 3.0]),
            A=no_rows(2), b=np.zeros(0),
            G=csr_array([[1.0, 0.0]]), h=np.array([self.h]),
            lb=np.zeros(2), ub=np.full(2, np.inf),
        )  # fmt: skip
        return Case(
            qp=qp, recover=lambda s: s.x, quantities=quantities, fields=fields,
        )  # fmt: skip


def at_the_row(qp):
    """Return the point with x₁ = h; for h > 2, only the sign of its
    multiplier is wrong.
    """
    h = qp.h[0]
    return Solution(
        status=Status.SOLVED, x=np.array([h, 0.0]), y=np.zeros(0),
        z=np.array([4 - 2 * h]), z_box=np.array([0.0, -3.0]), iterations=1,
    )  # fmt: skip


@dataclass(frozen=True)
class Honest:
    """Correct solver of the tiny QPs with h ≤ 2; most subclasses misbehave on
    these QPs only.
    """

    level: int = 3

    def declines(self, qp):
        return None

    def prepare(self, qp, tol):
        if qp.q[0] != -4.0:  # the warm-up
            return lambda: Solution.without_point(qp, Status.FAILED)
        return lambda: self.act(qp)

    def act(self, qp):
        return at_the_row(qp)


class Raises(Honest):
    def act(self, qp):
        raise ValueError("first line\nsecond line")


class Exits(Honest):
    def act(self, qp):
        sys.exit(3)


class Dies(Honest):
    def act(self, qp):
        print("my last words", file=sys.stderr, flush=True)
        os._exit(7)


class Segfaults(Honest):
    def act(self, qp):
        ctypes.string_at(0)


class Hangs(Honest):
    def act(self, qp):
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        time.sleep(3600)


class AlwaysHangs(Honest):
    """Solver that hangs even in the warm-up."""

    def prepare(self, qp, tol):
        time.sleep(3600)


class Prints(Honest):
    def act(self, qp):
        for _ in range(50):
            print("x" * 2**20)
        return at_the_row(qp)


class PrintsEndlessly(Honest):
    def act(self, qp):
        while True:
            print("x" * 2**20)


class AsksForTheMoon(Honest):
    """Solver that requests, in one allocation, more memory than the machine has."""

    def act(self, qp):
        np.ones(2**40)


class AbortsForMemory(Honest):
    """Solver that aborts like a Rust or C++ program after a failed allocation."""

    def act(self, qp):
        print("memory allocation of 64 bytes failed", file=sys.stderr, flush=True)
        os.abort()


class SpikesUnseen(Honest):
    """Solver that exceeds the memory limit only between two polls, then answers."""

    def act(self, qp):
        np.ones(2**26)  # 512 MiB
        return at_the_row(qp)


class ForksAHoarder(Honest):
    """Solver that exceeds the memory limit in a child process."""

    def act(self, qp):
        if os.fork() == 0:
            Leaks().act(qp)
        time.sleep(3600)


class WrongSign(Honest):
    """Solver that returns a multiplier of the wrong sign, with zero gap."""

    def act(self, qp):
        s = at_the_row(qp)
        return replace(s, z=-s.z)


class Sleeps(Honest):
    """Solver that sleeps for 20 ms."""

    def act(self, qp):
        time.sleep(0.02)
        return at_the_row(qp)


@dataclass(frozen=True)
class Chains(Honest):
    """Solver that reports the number of QPs of the sequence so far as iterations."""

    def chain(self, tol):
        seen = []

        def prepare(qp):
            seen.append(qp)
            return lambda: replace(at_the_row(qp), iterations=len(seen))

        return prepare


class Leaks(Honest):
    def act(self, qp):
        hoard = []
        while True:
            hoard.append(np.ones(2**22))  # 32 MiB
            time.sleep(0.001)


class Forks(Honest):
    def act(self, qp):
        child = os.fork()
        if child == 0:
            time.sleep(3600)
        return replace(at_the_row(qp), counts={"child": child})


def above(process):
    """Return the process ID of the parent of a process."""
    return int(Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[1])


class ReturnsTwice(Honest):
    """Solver whose forked child returns first.

    Each process reports the process ID of its grandparent.
    """

    def act(self, qp):
        if os.fork() != 0:
            time.sleep(0.2)
        return replace(at_the_row(qp), counts={"above": above(os.getppid())})


class WrongShape(Honest):
    def act(self, qp):
        return replace(at_the_row(qp), x=np.zeros(3))


class ReturnsNone(Honest):
    def act(self, qp):
        return None


class ReturnsNaN(Honest):
    def act(self, qp):
        return replace(at_the_row(qp), x=np.array([np.nan, 0.0]))


class Zero(Honest):
    """Solver that claims that x = 0 is the solution."""

    def act(self, qp):
        return replace(at_the_row(qp), x=np.zeros(2), z=np.zeros(1), z_box=np.zeros(2))


class Mutates(Honest):
    def act(self, qp):
        qp.q[:] = 0.0


class MutatesByForce(Honest):
    """Solver that returns the correct answer, then changes the arrays of the QP."""

    def act(self, qp):
        answer = at_the_row(qp)
        for array in (qp.q, qp.h, qp.P.data):
            array.flags.writeable = True
            array[:] = 0.5
        return answer


class Warm(Honest):
    """Solver that needs fewer iterations when a prepared QP is solved again."""

    def prepare(self, qp, tol):
        iterations = iter([9, 1, 1])
        return lambda: replace(at_the_row(qp), iterations=next(iterations))


class Declines(Honest):
    def declines(self, qp):
        return "never on a Monday"


class LacksUndeclared(Honest):
    """Solver that imports a missing module, which it does not declare."""

    def prepare(self, qp, tol):
        import a_library_nobody_has  # noqa: F401


class Lacks(LacksUndeclared):
    """Solver that declares the missing package."""

    about = About(
        title="", method="", licence="", linear_solver="", phases="",
        package="a_library_nobody_has",
    )  # fmt: skip


class Breaks(Honest):
    """Solver that declares an installed package, in which a name is missing."""

    about = replace(Lacks.about, package="numpy")

    def prepare(self, qp, tol):
        from numpy import no_such_function  # noqa: F401


def unsolved(qp):
    """Raise ArithmeticError: without a reference solution, residuals decide."""
    raise ArithmeticError("no reference solve")


SOLVERS = {
    name.lower(): kind()
    for name, kind in list(globals().items())
    if isinstance(kind, type) and issubclass(kind, Honest)
}
PROBLEMS = {"tiny": Tiny()}

if __name__ == "__main__":
    what, *pipes = sys.argv[1:]
    cases = Cases(PROBLEMS, unsolved)
    serve(Worker(solver=SOLVERS.get(what), cases=cases), *map(int, pipes))
