"""Scaling is exact, and rounding forgets errors of rounding."""

import numpy as np
import pytest
from scipy.sparse import csc_array, random_array

from mortarbench import QP, Discs
from mortarbench.dataset.items import NO_BITS
from mortarbench.dataset.selection import CAP, choose_core
from mortarbench.dataset.standard import (
    SHIFT,
    last_bits,
    numbers,
    rounded,
    scaled,
    scales_of,
)


def random_qp(seed, *, dense):
    rng = np.random.default_rng(seed)
    factor = random_array((12, 9), density=0.5, rng=rng).toarray()
    P = 1e3 * (factor.T @ factor) + np.diag(rng.uniform(0.1, 1e3, 9))
    box = np.array([rng.uniform(0, 1), *[np.inf] * 8])
    return QP(
        P=P if dense else csc_array(P),
        q=1e-2 * rng.standard_normal(9),
        A=csc_array(rng.standard_normal((2, 9))),
        b=rng.standard_normal(2),
        G=csc_array(rng.standard_normal((3, 9))),
        h=rng.uniform(0, 1, 3),
        lb=-box,
        ub=box,
        sets=[Discs([[3, 4], [7, 6]], [0.3, 1.7])],
    )


@pytest.mark.parametrize("dense", [True, False])
def test_scaling_by_powers_of_two_is_exact(dense):
    qp, scales = random_qp(1, dense=dense), (-3, 5, 2, -1)
    new, x = scaled(qp, scales), np.linspace(-1, 1, 9)
    assert new.objective(x * 8) == 2.0**5 * qp.objective(x)
    assert np.array_equal(new.h - new.G @ (8 * x), (qp.h - qp.G @ x) / 2)
    assert new.sets[1].radius.tolist() == [2.4, 13.6]
    assert new.ub[0] == 8 * qp.ub[0]


def test_scaled_data_are_of_order_one():
    qp = random_qp(2, dense=False)
    new = scaled(qp, scales_of(qp, -3e-7))
    for size in (abs(new.P).max(), abs(new.A).max(), abs(new.G).max()):
        assert 1 / 8 <= size <= 8


@pytest.mark.parametrize("dense", [True, False])
def test_rounding_is_small_idempotent_and_symmetric(dense):
    qp = random_qp(3, dense=dense)
    once = rounded(qp, NO_BITS, is_shifted=False)
    twice = rounded(once, NO_BITS, is_shifted=False)
    for name, (vector, unit) in numbers(qp).items():
        new = numbers(once)[name][0]
        finite = np.isfinite(vector)
        assert (np.abs(new[finite] - vector[finite]) <= 0.5 * np.max(unit)).all()
        assert np.array_equal(new, numbers(twice)[name][0])
    assert abs(once.P - once.P.T).max() == 0
    assert once.sets[1].index.tolist() == [[3, 4], [7, 6]]


def test_the_stored_bits_undo_errors_of_a_hundred_units():
    rng = np.random.default_rng(4)
    qp = random_qp(4, dense=True)
    bits = last_bits(qp)
    noise = 1 + 5e-11 * rng.uniform(-1, 1, (9, 9))
    noisy = QP(
        P=qp.P * (noise + noise.T) / 2,
        q=qp.q * (1 + 5e-11),
        A=qp.A, b=qp.b, G=qp.G, h=qp.h, lb=qp.lb, ub=qp.ub * (1 - 5e-11),
        sets=[Discs(qp.sets[1].index, qp.sets[1].radius * (1 + 5e-11))],
    )  # fmt: skip
    one, other = (rounded(each, bits, is_shifted=False) for each in (qp, noisy))
    assert np.array_equal(one.P, other.P)
    assert np.array_equal(one.q, other.q)
    assert np.array_equal(one.ub, other.ub)
    assert np.array_equal(one.sets[1].radius, other.sets[1].radius)


def test_the_shift_is_a_small_part_of_the_diagonal():
    qp = random_qp(5, dense=False)
    plain, shifted = (rounded(qp, NO_BITS, is_shifted=flag) for flag in (False, True))
    added = (shifted.P - plain.P).toarray()
    assert np.array_equal(added, np.diag(added.diagonal()))
    ratio = added.diagonal() / (SHIFT * plain.P.diagonal())
    assert (ratio >= 1 / 4).all()
    assert (ratio <= 4).all()


def line(name, n, sequence=""):
    numbers = dict.fromkeys(("nnz", "rank", "active_share", "equalities"), "1")
    return numbers | {
        "n": str(n), "name": name, "sequence": sequence, "family": name[0],
        "core": "no", "condition": "1", "degeneracy": "0", "inequalities": "0",
        "discs": "0", "dense": "no", "kind": "optimal",
    }  # fmt: skip


def test_the_core_has_a_cap_per_family_and_prefers_distant_problems():
    rows = [line(f"a{n}", 10 + n) for n in range(20)]
    rows += [line("a", 1e6), line("b", 10), line("c/001", 1e9, "c")]
    choose_core(rows)
    core = {row["name"] for row in rows if row["core"] == "yes"}
    assert sum(name.startswith("a") for name in core) == CAP
    assert {"a", "b"} <= core
    assert "c/001" not in core
