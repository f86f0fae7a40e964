"""A sound solver, and solvers with planted faults, for tests of conformance checks."""

import os
import signal
import time
from dataclasses import dataclass, replace

import numpy as np

from mortarbench.harness import Solution, Status
from mortarbench.solvers import SOLVERS as SOUND_SOLVERS


def work(seconds):
    """Sleep; tests replace this function to advance a clock of their own."""
    time.sleep(seconds)


@dataclass(frozen=True)
class Sound:
    """PIQP under another name; base class of the faulty solvers."""

    spoilt: str = ""

    def declines(self, qp):
        return SOUND_SOLVERS["piqp"].declines(qp)

    def prepare(self, qp, tol):
        return lambda: self.act(qp, tol)

    def act(self, qp, tol):
        return self.honest(qp, tol)

    def honest(self, qp, tol):
        work(0.0)
        return SOUND_SOLVERS["piqp"].prepare(qp, tol)()


class StopsEarly(Sound):
    def act(self, qp, tol):
        return self.honest(qp, 0.1)


class FlipsSigns(Sound):
    def act(self, qp, tol):
        s = self.honest(qp, tol)
        return replace(s, y=-s.y)


class Remembers(Sound):
    def act(self, qp, tol):
        s = self.honest(qp, tol)
        first = not MEMORY
        MEMORY.append(s)
        return s if first else replace(s, iterations=1)


MEMORY = []


class Caches(Sound):
    """Solver that solves each QP with a new key once; `key` is set by subclasses."""

    def act(self, qp, tol):
        answers = MEMORIES.setdefault(type(self).__name__, {})
        key = self.key(qp)
        if key not in answers:
            # the object is kept, so that its address is not reused
            answers[key] = qp, self.honest(qp, tol)
        return answers[key][1]


class CachesById(Caches):
    def key(self, qp):
        return id(qp)


class CachesByContent(Caches):
    def key(self, qp):
        return qp.q.tobytes()


class CachesByShape(Caches):
    def key(self, qp):
        return qp.P.shape, qp.A.shape, qp.G.shape


class CachesByAddress(Caches):
    def key(self, qp):
        return qp.q.ctypes.data


class CachesThePreparation(Sound):
    """Solver whose preparation, which takes 0.15 s, is reused for an equal P."""

    def prepare(self, qp, tol):
        known = MEMORIES.setdefault("preparation", set())
        if (key := qp.P.data.tobytes()) not in known:
            work(0.15)
            known.add(key)
        return SOUND_SOLVERS["piqp-dense"].prepare(qp, tol)


class Compiles(Sound):
    """Solver that takes 0.3 s longer in the first solve of each shape, as JAX does."""

    def key(self, qp):
        return qp.P.shape, qp.A.shape, qp.G.shape

    def act(self, qp, tol):
        known = MEMORIES.setdefault(type(self).__name__, set())
        if (key := self.key(qp)) not in known:
            work(0.3)
            known.add(key)
        return self.honest(qp, tol)


class CompilesOnce(Compiles):
    """Solver that takes 0.3 s longer in its first solve, as with Numba."""

    def key(self, qp):
        return "any"


class ReusesPatterns(Compiles):
    """Solver that analyses each sparsity pattern once, in 0.3 s."""

    def key(self, qp):
        return qp.P.indices.tobytes()


MEMORIES = {}


class Raises(Sound):
    def act(self, qp, tol):
        raise ValueError("not today")


class Wanders(Sound):
    def act(self, qp, tol):
        s = self.honest(qp, tol)
        return replace(s, x=s.x + 1e-9 * np.random.default_rng().standard_normal())


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
    """Solver that claims that its first point is optimal, like HiGHS 1.15.1 without
    rows.
    """

    def act(self, qp, tol):
        s = self.honest(qp, tol)
        return replace(s, x=qp.lb) if qp.q.size == 400 else s


class MindsUnits(Sound):
    """Solver that fails for large numbers, as with an absolute tolerance."""

    def act(self, qp, tol):
        s = self.honest(qp, tol)
        return s if abs(qp.q).max() < 1e6 else replace(s, x=1.01 * s.x)


class MindsTheOrder(Sound):
    """Solver that fails unless the fifth unknown is at its lower bound."""

    def act(self, qp, tol):
        s = self.honest(qp, tol)
        return replace(s, status=Status.FAILED) if s.z_box[4] > -0.1 else s


class RepeatsTheFirst(Sound):
    def chain(self, tol):
        prepare = SOUND_SOLVERS["piqp"].chain(tol)
        first = []

        def next_one(qp):
            first.append(prepare(qp))
            return first[0]

        return next_one


class DeclinesAll(Sound):
    def declines(self, qp):
        return "never on a Monday"


class SaysFalse(Sound):
    def declines(self, qp):
        return False


class Dies(Sound):
    def act(self, qp, tol):
        os.kill(os.getpid(), signal.SIGSEGV)


SOLVERS = {
    "sound": Sound(), "dies": Dies(), "declines": DeclinesAll(), "minds": MindsUnits(),
    "false": SaysFalse(), "raises": Raises(),
    "id": CachesById(), "content": CachesByContent(), "shape": CachesByShape(),
    "compiles": Compiles(),
}  # fmt: skip
