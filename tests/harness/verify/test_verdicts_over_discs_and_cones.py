"""Verdicts over discs and cones, tested with points that are not solutions.

Components of planted solutions are integers times powers of two; on discs and cones,
they form Pythagorean pairs. Therefore f* and all errors are known in fractions.
"""

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

import mortarbench as mb
from mortarbench.harness import QP, Cones, Discs, Solution, Status
from mortarbench.harness.conformance.metamorphic import (
    mirror,
    shift_unknowns,
)
from mortarbench.harness.verify.kkt import allowed, kkt_residuals
from mortarbench.harness.verify.multipliers import with_multipliers
from tests.support.rational import rational

PAIRS = [(3, 4, 5), (5, 12, 13), (8, 15, 17), (-7, 24, 25), (4, -3, 5)]
INF = np.inf
#: traps, which are tested singly and in pairs
TRAPS = (
    "tiny", "small", "wide", "point", "flat", "steep", "no friction", "apex",
    "degenerate", "touching", "singular", "cancelled", "weak", "units",
)  # fmt: skip
#: units of a radius that is combined with radii of order one
UNITS = {"tiny": 2.0**-27, "small": 2.0**-8, "wide": 2.0**27}
FLAT, STEEP = 2.0**-16, 2.0**16  #: slopes for which all sums are exact


class ExactProblem:
    """A QP over discs, cones, bounds and rows, with its exact solution and f*.

    With the trap "touching", two rows x₁ − x₂ = c leave a single point of two discs.
    """

    def __init__(self, traps, seed):
        rng = self.rng = np.random.default_rng(seed)
        discs, cones = (int(rng.integers(0, 3)) for _ in range(2))
        discs = max(discs, 2 if "touching" in traps else 0)
        if not discs + cones:
            discs = cones = 1
        alone = int(rng.integers(1, 4))
        n = 2 * discs + 3 * cones + alone
        order = rng.permutation(n)
        on_discs, on_cones, others = np.split(order, [2 * discs, 2 * discs + 3 * cones])
        self.x, self.z = np.zeros(n), np.zeros(n)
        index = on_discs.reshape(discs, 2), on_cones.reshape(cones, 3)
        radius = [self.disc(b, traps if i == 0 else ()) for i, b in enumerate(index[0])]
        slope = [self.cone(b, traps if i == 0 else ()) for i, b in enumerate(index[1])]
        x, z = self.x, self.z
        lb, ub = np.full(n, -INF), np.full(n, INF)
        x[others] = rng.integers(-4, 5, alone)
        for j in others:
            lb[j], ub[j] = x[j] - rng.integers(0, 2), x[j] + rng.integers(1, 9)
            z[j] = -float(rng.integers(0, 4)) if lb[j] == x[j] else 0
        m, p = rng.integers(0, 3, 2)
        M = rng.integers(-3, 4, (n - (2 if "singular" in traps else 0), n))
        P = (M.T @ M + (0 if "singular" in traps else np.eye(n))).astype(float)
        if "weak" in traps:
            P *= 2.0**-20
        A, G = (rng.integers(-3, 4, (r, n)).astype(float) for r in (m, p))
        if "touching" in traps:  # x₂ = −x₁: the points with the largest distance
            one, two = index[0][:2]
            x[two] = -x[one]
            radius[1] = radius[0] = float(np.hypot(*x[one]))
            z[two] = -z[one]
            A = np.vstack([A, np.zeros((2, n))])
            A[-2:, one], A[-2:, two] = np.eye(2), -np.eye(2)
        y = rng.integers(-9, 10, len(A)) * (2.0**20 if "cancelled" in traps else 1)
        mu = rng.integers(0, 9, p).astype(float)
        h = G @ x + np.where(mu == 0, rng.integers(0, 9, p), 0)
        u = 2.0**30 if "units" in traps else 1.0
        q = -(P @ x + A.T @ y + G.T @ mu + z)
        sets = (Discs(index[0], u * np.array(radius)), Cones(index[1], slope))
        self.qp = QP(
            P=P / u**2, q=q / u, A=A, b=u * (A @ x), G=G, h=u * h, lb=u * lb, ub=u * ub,
            sets=sets,
        )  # fmt: skip
        self.solution = Solution(
            status=Status.SOLVED, x=u * x, y=y / u, z=mu / u, z_box=z / u
        )
        self.exact = exact_objective(self.qp, u * x)
        self.value = float(self.exact)

    def pair(self):
        a, b, c = PAIRS[self.rng.integers(len(PAIRS))]
        return np.array([a, b], dtype=float), float(c)

    def disc(self, block, traps):
        """Plant a solution on or inside a disc; return its radius."""
        at, radius = self.pair()
        unit = next((UNITS[trap] for trap in UNITS if trap in traps), 1.0)
        if "point" in traps:  # any force is normal
            self.z[block] = self.rng.integers(-9, 10, 2)
            return 0.0
        self.x[block] = unit * at
        if self.rng.random() < 0.3:  # inside
            return 2 * unit * radius
        if "degenerate" not in traps:
            self.z[block] = self.rng.integers(1, 9) * at
        return unit * radius

    def cone(self, block, traps):
        """Plant a solution on or inside a cone; return its slope."""
        at, size = self.pair()
        normal, tangents = block[0], block[1:]
        slope = 2.0 ** int(self.rng.integers(-2, 2))
        slope *= FLAT if "flat" in traps else STEEP if "steep" in traps else 1.0
        pull = self.rng.integers(1, 9) * (0.0 if "degenerate" in traps else 1.0)
        if "no friction" in traps:
            self.z[tangents] = self.rng.integers(-9, 10, 2)
            if self.rng.random() < 0.5:
                self.x[normal] = size
            else:
                self.z[normal] = -float(self.rng.integers(0, 9))
            return 0.0
        state = self.rng.random()
        if "apex" in traps or state < 0.3:  # open
            self.z[tangents] = pull * at
            self.z[normal] = -slope * pull * size - self.rng.integers(0, 3)
        elif state < 0.7:  # slips
            self.x[tangents], self.x[normal] = at, size / slope
            self.z[tangents], self.z[normal] = pull * at, -slope * pull * size
        else:  # sticks
            self.x[tangents], self.x[normal] = at, 2 * size / slope
        return slope


@pytest.mark.parametrize("trap", ["", *TRAPS])
def test_planted_points_are_solutions_to_the_last_digit(trap):
    for seed in range(10):
        planted = ExactProblem({trap}, seed)
        qp, s = planted.qp, planted.solution
        force = [Fraction(0)] * qp.q.size
        for j in range(qp.q.size):
            for a, v in (
                (qp.P[j], s.x), (qp.A[:, j], s.y), (qp.G[:, j], s.z),
                ([1.0, 1.0], [qp.q[j], s.z_box[j]]),
            ):  # fmt: skip
                for b, c in zip(a, v, strict=True):
                    force[j] += Fraction(b) * Fraction(c)
        if trap != "cancelled":
            assert not any(force)
        assert (qp.A @ s.x == qp.b).all()
        assert (qp.G @ s.x <= qp.h).all()
        assert (s.z * (qp.h - qp.G @ s.x) == 0).all()
        assert ((qp.lb <= s.x) & (s.x <= qp.ub)).all()
        for one in qp.sets[1:]:
            sizes = one.radius if isinstance(one, Discs) else one.slope
            for block, size in zip(one.index, sizes, strict=True):
                x, z = ([Fraction(c) for c in v[block]] for v in (s.x, s.z_box))
                if isinstance(one, Discs):
                    assert x[0] ** 2 + x[1] ** 2 <= Fraction(size) ** 2
                    if size and any(z):  # normal: along x, and x is on the boundary
                        assert x[0] * z[1] == x[1] * z[0]
                        assert x[0] * z[0] + x[1] * z[1] > 0
                        assert x[0] ** 2 + x[1] ** 2 == Fraction(size) ** 2
                else:
                    slope = Fraction(size)
                    assert x[0] >= 0 >= z[0]
                    assert x[1] ** 2 + x[2] ** 2 <= (slope * x[0]) ** 2
                    assert slope**2 * (z[1] ** 2 + z[2] ** 2) <= z[0] ** 2
                    assert sum(a * b for a, b in zip(x, z, strict=True)) == 0
        assert kkt_residuals(qp, s).worst <= 1e-14


def exact_objective(qp, x):
    P, q, x = rational(qp.P), rational(qp.q), rational(x)
    return x @ (P @ x) / 2 + q @ x


class Attack:
    """Points of a planted QP: solutions up to rounding, and moves away from one."""

    def __init__(self, planted, rng):
        self.qp, self.s, self.rng = planted.qp, planted.solution, rng
        self.value, x = np.longdouble(planted.value), self.s.x
        self.length = np.abs(x).max()
        self.terms = max(
            abs(x @ (self.qp.P @ x)),
            np.abs(self.qp.q) @ np.abs(x),
            1e-3 * np.abs(self.qp.P).max() * self.length**2,
            1e-3 * np.abs(self.qp.q).max() * self.length,
        )

    def error(self, x):
        """Return the larger of the errors of the objective and of the constraints.

        Constraints are relative to their terms; those without a unit of their own
        (right-hand side, bound or radius 0, and cones), to 0.1‖x*‖∞.
        """
        qp, x = self.qp, x.astype(np.longdouble)
        worst = abs(float(x @ (qp.P @ x) / 2 + qp.q @ x - self.value)) / self.terms
        x = x.astype(float)
        size = np.maximum(np.abs(x), np.abs(self.s.x))
        rows = [
            (off, np.abs(rhs), np.abs(M) @ size, np.abs(M).max(axis=1))
            for off, M, rhs in (
                (np.abs(qp.A @ x - qp.b), qp.A, qp.b), (qp.G @ x - qp.h, qp.G, qp.h)
            )
        ]  # fmt: skip
        for one in qp.sets:
            for here, there in zip(one.limits(x), one.limits(self.s.x), strict=True):
                terms = np.maximum(here.terms, there.terms)
                rows.append((-here.slack, here.size, terms, np.ones(terms.size)))
        for off, own, terms, largest in rows:
            least = np.where(own > 0, 1e-3, 0.1) * self.length * largest
            ratio = off / np.maximum(own + terms, np.maximum(least, 1e-300))
            worst = max(worst, ratio.max(initial=0.0))
        return worst

    def rounded(self, tol):
        """Return the solution, disturbed by nothing, two units or 0.1·tol."""
        size = self.rng.choice([0, 2.0**-52, 0.1 * tol])

        def off(v):
            return v * (1 + size * self.rng.uniform(-1, 1, v.size))

        x, y, z, z_box = map(off, (self.s.x, self.s.y, self.s.z, self.s.z_box))
        return replace(self.s, x=self.project(x), y=y, z=z, z_box=z_box)

    def moved(self, s, tol):
        rng, x = self.rng, s.x
        unit = np.where(x != 0, np.abs(x), self.length)
        size = 10 ** rng.uniform(np.log10(tol) - 1, 0.5)
        match rng.integers(0, 6):
            case 0:  # one variable
                here = np.arange(x.size) == rng.integers(x.size)
                x = x + size * unit * rng.standard_normal() * here
            case 1:  # all variables
                x = x + size * unit * rng.standard_normal(x.size)
            case 2:  # along active rows
                x = x + size * self.along_rows(x, unit * rng.standard_normal(x.size))
            case 3:  # along the boundary of a disc or cone
                x = self.turned(x, size)
            case 4:  # another vertex
                x = np.where(rng.random(x.size) < 0.3, 0, x)
        x = self.project(x) if rng.random() < 0.6 else x
        return self.with_multipliers(replace(s, x=x), size)

    def with_multipliers(self, s, size):
        """Return `s` with other multipliers in five of six cases."""
        rng, qp = self.rng, self.qp
        angle = 10 ** rng.uniform(-9, 0.5)
        match rng.integers(0, 6):
            case 0:
                return with_multipliers(qp, s.x) if rng.random() < 0.05 else s
            case 1 | 2:  # stationary up to rounding, perhaps not normal
                block = np.zeros(qp.q.size, dtype=bool)
                for one in qp.sets[1:]:
                    block[one.block] = True
                force = qp.P @ s.x + qp.q + qp.A.T @ s.y + qp.G.T @ s.z
                return replace(s, z_box=np.where(block, -force, s.z_box))
            case 3:
                return replace(s, z_box=self.turned(s.z_box, angle))
            case 4:  # the wrong sign
                return replace(s, z_box=-s.z_box) if rng.random() < 0.3 else s
            case _:
                y, z, z_box = (
                    v * (1 + size * rng.standard_normal(v.size))
                    for v in (s.y, s.z, s.z_box)
                )
                return replace(s, y=y, z=z, z_box=z_box)

    def along_rows(self, x, step):
        qp = self.qp
        tight = qp.h - qp.G @ x <= 1e-9 * (abs(qp.h) + abs(qp.G) @ abs(x))
        B = np.vstack([qp.A, qp.G[tight]])
        return step - np.linalg.pinv(B) @ (B @ step) if B.size else step

    def project(self, x):
        for one in self.qp.sets:
            x = one.project(x)
        return x

    def turned(self, v, angle):
        """Rotate the tangential components of one block."""
        one = self.qp.sets[1 + self.rng.integers(len(self.qp.sets) - 1)]
        block = one.index[self.rng.integers(len(one.index))][-2:]
        c, s = np.cos(angle), np.sin(angle)
        v = v.copy()
        v[block] = np.array([[c, -s], [s, c]]) @ v[block]
        return v


def search(seed, tries, each=50):
    """Return the wrong verdicts on points of QPs with up to two traps, and counts.

    A point is right if it is planted up to 0.1·tol and its error is at most tol, and
    wrong if its error exceeds 100·tol. Every third move starts from the worst point
    that was verified.
    """
    rng, count = np.random.default_rng(seed), {"right": 0, "wrong": 0}
    verified, refuted = [], []
    for k in range(tries // each):
        traps = {str(t) for t in rng.choice(TRAPS, rng.integers(0, 3))}
        number, tol = int(rng.integers(2**30)), (1e-8, 1e-6, 1e-4)[k % 3]
        attack = Attack(ExactProblem(traps, number), rng)
        worst, most = attack.s, 0.0
        for i in range(each):
            planted = i % 10 == 0
            start = worst if i % 3 == 2 else attack.s
            s = attack.rounded(tol) if planted else attack.moved(start, tol)
            error = attack.error(s.x)
            passed = kkt_residuals(attack.qp, s).worst <= allowed(tol)
            if planted and error <= tol:
                count["right"] += 1
                refuted += [] if passed else [(sorted(traps), number, tol, s)]
            if error > 100 * tol:
                count["wrong"] += 1
                verified += [(sorted(traps), number, tol, s)] if passed else []
            if passed and not planted and error > most:
                worst, most = s, error
    return verified, refuted, count


@pytest.mark.parametrize(
    ("seed", "tries"), [(2, 1500), pytest.param(3, 25_000, marks=pytest.mark.slow)]
)
def test_few_points_of_a_search_are_judged_wrongly(seed, tries):
    """At tol 1e-4, weak directions of steep and flat cones hide an energy."""
    with np.errstate(all="ignore"):
        verified, refuted, count = search(seed, tries)

    assert count["right"] > 0.09 * tries
    assert count["wrong"] > 0.3 * tries
    assert len(verified) <= 0.004 * count["wrong"]
    assert len(refuted) <= 0.004 * count["right"]
    assert all({"steep", "flat", "singular", "weak"} & {*t} for t, *_ in verified)


@pytest.mark.parametrize("tol", [1e-8, 1e-4])
@pytest.mark.parametrize("trap", ["", "small", "weak", "units"])
def test_a_point_outside_a_disc_by_a_hundred_tolerances_is_refuted(trap, tol):
    """Radii are at least 1e-4 of the length of x; moves are radial."""
    for seed in range(20):
        planted = ExactProblem({trap, "singular"}, seed)
        qp, s = planted.qp, planted.solution
        for one in qp.sets[1:]:
            if not isinstance(one, Discs):
                continue
            for block, radius in zip(one.index, one.radius, strict=True):
                x = s.x.copy()
                x[block] *= (1 + 100 * tol) * radius / np.linalg.norm(x[block])
                assert kkt_residuals(qp, replace(s, x=x)).primal > allowed(tol)


@pytest.mark.parametrize("trap", ["", "tiny", "units"])
def test_multipliers_of_the_wrong_sign_or_direction_are_refuted(trap):
    """Test the multipliers unchanged, and with another q for which the point is
    stationary.
    """
    count = 0
    for seed in range(20):
        planted = ExactProblem({trap}, seed)
        qp, s = planted.qp, planted.solution
        for one in qp.sets[1:]:
            for block in one.index:
                if not s.z_box[block].any():
                    continue
                for way in (_reverse, _turn, _shorten_normal):
                    z_box = s.z_box.copy()
                    z_box[block] = way(z_box[block], one, block)
                    if (z_box == s.z_box).all():
                        continue
                    count += 1
                    other = replace(s, z_box=z_box)
                    assert kkt_residuals(qp, other).worst > 1e-7
                    balanced = replace(qp, q=qp.q + s.z_box - z_box)
                    r = kkt_residuals(balanced, other)
                    if np.linalg.norm(s.x[block]) > 1e-3 * np.linalg.norm(s.x):
                        assert r.worst > 1e-7, (seed, block, way)
                    if way is _shorten_normal:
                        assert r.dual > 1e-7
    assert count > 20


def _reverse(z, one, block):
    return -z


def _turn(z, one, block):
    """Rotate the tangential components by 0.1."""
    c, s = np.cos(0.1), np.sin(0.1)
    return np.append(z[:-2], np.array([[c, -s], [s, c]]) @ z[-2:])


def _shorten_normal(z, one, block):
    """Shorten the normal component, so that the vector leaves the polar cone."""
    if isinstance(one, Discs):
        return z
    slope = one.slope[(one.index == block).all(axis=1)]
    return np.append(-0.9 * slope * np.linalg.norm(z[1:]), z[1:])


@pytest.mark.parametrize(("length", "accepted"), [(1e-10, True), (1e-5, False)])
def test_a_tiny_disc_is_judged_relative_to_its_neighbour(length, accepted):
    """At the edge of a contact zone, a friction bound is far below rounding."""
    P = np.eye(4) + np.kron(np.ones((2, 2)), np.eye(2))
    qp = QP.from_arrays(P, [-3, 0, -3, 0], sets=[Discs([[0, 1], [2, 3]], [1, 1e-12])])
    found = mb.verify(qp, np.array([1.0, 0, length, 0]), tol=1e-8)
    assert (found.verdict is mb.Verdict.VERIFIED) == accepted


def test_multipliers_are_computed_at_the_apex_of_all_cones():
    """At the apex, neither x nor a force defines a length; q acts only on x₄."""
    qp = mb.QP.from_arrays(
        np.eye(4), [0, 0, 0, -1], A=[[1, 0, 0, 1]], b=1, sets=[Cones([[0, 1, 2]], [1])]
    )
    found = mb.verify(qp, [0, 0, 0, 1])
    assert found.verdict is mb.Verdict.VERIFIED
    assert found.multipliers.y == pytest.approx([0], abs=1e-12)


def test_a_reversed_or_shifted_cone_is_refused():
    qp = mb.QP.from_arrays(np.eye(3), [1, 1, 1], sets=[Cones([[0, 1, 2]], [1])])
    with pytest.raises(ValueError, match="Cones cannot be scaled unevenly or rever"):
        mirror(qp, [0])
    with pytest.raises(ValueError, match="Cones cannot be shifted"):
        shift_unknowns(qp, np.ones(3))
