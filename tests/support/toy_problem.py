"""Plug-in with quadratics over x ≥ 0, and with solvers, some of which misbehave.

If the module is run as a program, it acts as a worker whose registries contain only
this family and these solvers.
"""

import os
import signal
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np

from mortarbench.cli.main import main
from mortarbench.harness import (
    QP,
    Case,
    Family,
    Fields,
    InputError,
    Range,
    Solution,
    Status,
    no_rows,
)
from mortarbench.registries import Registries

FAULTS = {
    13: KeyboardInterrupt(),
    97: InputError("well: depth=97 is out of range"),
    98: MemoryError("Unable to allocate 1 PiB"),
    99: ZeroDivisionError("a fault of ours"),
}


@dataclass(frozen=True)
class Well(Family):
    """Separable quadratics over x ≥ 0."""

    forms: ClassVar = ("primal", "dual")

    n: Annotated[int, Range(1), "unknowns"] = 3
    depth: int = 1

    def build(self, form, reference):
        """Return  min ½|x|² − depth·Σx, x ≥ 0:  x = depth, objective −n·depth²/2."""
        n, depth = self.n, self.depth
        if depth in FAULTS:
            raise FAULTS[depth]
        qp = QP(
            P=np.eye(n), q=np.full(n, -float(depth)),
            A=no_rows(n), b=np.zeros(0), G=no_rows(n), h=np.zeros(0),
            lb=np.zeros(n), ub=np.full(n, np.inf),
        )  # fmt: skip
        return Case(
            qp=qp,
            recover=lambda s: s.x,
            quantities=lambda s: {
                **({"dofs": n} if form == "primal" else {}),
                "energy": 2 * qp.objective(s.x),
                "tip": s.x[:2],
            },
            fields=self.fields if form == "primal" else None,
            scale=2.0,
        )

    def fields(self, s):
        return Fields(
            points=np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]),
            cells=np.array([[0, 1, 2, 3]]),
            bodies=np.zeros(1, dtype=np.int64),
            displacement=np.zeros((4, 2)),
        )


@dataclass(frozen=True)
class Exact:
    """Solver for P = I and inactive bounds."""

    factor: float = 1.0
    reason: str | None = None

    def declines(self, qp):
        return self.reason

    def prepare(self, qp, tol):
        zeros = dict(y=np.zeros(0), z=np.zeros(0), z_box=0 * qp.q)
        return lambda: Solution(status=Status.SOLVED, x=-self.factor * qp.q, **zeros)


@dataclass(frozen=True)
class Lost(Exact):
    def prepare(self, qp, tol):
        return lambda: Solution.without_point(qp, Status.FAILED, "nowhere to go")


@dataclass(frozen=True)
class Prints(Exact):
    def prepare(self, qp, tol):
        print("from Python")
        os.write(1, b"from C\n")
        return super().prepare(qp, tol)


@dataclass(frozen=True)
class Dies(Exact):
    def prepare(self, qp, tol):
        print("my last words", flush=True)
        os._exit(7)


@dataclass(frozen=True)
class Hangs(Exact):
    """Solver that hangs, ignores Ctrl-C and creates $STARTED, except in the warm-up."""

    def prepare(self, qp, tol):
        if qp.q.size != 2:
            signal.pthread_sigmask(signal.SIG_BLOCK, [signal.SIGINT])
            Path(os.environ["STARTED"]).write_text(str(os.getpid()))
            time.sleep(3600)
        return super().prepare(qp, tol)


@dataclass(frozen=True)
class Slow(Exact):
    """Solver that sleeps and, except in the warm-up, adds a line to $STARTS."""

    seconds: float = 0.4

    def prepare(self, qp, tol):
        if qp.q.size != 2:
            with Path(os.environ["STARTS"]).open("a") as starts:
                starts.write(f"{os.getpid()} {os.sched_getaffinity(0)}\n")
            time.sleep(self.seconds)
        return super().prepare(qp, tol)


@dataclass(frozen=True)
class Murders(Exact):
    """Solver that kills the supervising process if the depth is 4."""

    def prepare(self, qp, tol):
        if qp.q[0] == -4:
            reaper = Path(f"/proc/{os.getppid()}/stat").read_text()
            os.kill(int(reaper.rpartition(")")[2].split()[1]), signal.SIGKILL)
        return super().prepare(qp, tol)


@dataclass(frozen=True)
class Lax(Exact):
    """Solver whose relative errors equal the tolerance."""

    def prepare(self, qp, tol):
        return Exact(factor=1 + tol).prepare(qp, tol)


SOLVERS = {
    "exact": Exact(),
    "lax": Lax(),
    "near": Exact(factor=1.001),
    "liar": Exact(factor=1.5),
    "picky": Exact(reason="never on a Monday"),
    "lost": Lost(),
    "prints": Prints(),
    "dies": Dies(),
    "hangs": Hangs(),
    "slow": Slow(),
    "murders": Murders(),
}
PROBLEMS = {"well": Well()}


def unsolved(qp):
    """Raise ArithmeticError: without a reference solution, residuals decide."""
    raise ArithmeticError("toy problems have no reference solve")


if __name__ == "__main__":
    registries = Registries(families=PROBLEMS, solvers=SOLVERS, reference=unsolved)
    sys.exit(main(registries, sys.argv[1:]))
