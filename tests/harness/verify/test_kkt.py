"""The four residuals: single broken conditions, invariances, verdicts and diagnoses."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse.linalg import LinearOperator, aslinearoperator

from mortarbench.harness import (
    QP,
    Discs,
    Residuals,
    Status,
    Verdict,
    verdict,
)
from mortarbench.harness.operators import SerialisableOperator
from mortarbench.harness.record import Record
from mortarbench.harness.verify.kkt import (
    diagnosis,
    kkt_residuals,
    largest_eigenvalue,
    scaling_of,
)
from mortarbench.harness.verify.verdicts import judged
from tests.support.small_qps import at

INF = np.inf
qp_of = QP.from_arrays
#: min ½‖x‖² − x₁ − x₂ at (1, 1), and one row or bound; the scaling is that of the data
FREE = dict(P=np.eye(2), q=[-1, -1])
ONES, APART = [[1, 1]], [[1, -1]]


@pytest.mark.parametrize(
    ("constraint", "x", "expected"),
    [
        (dict(A=ONES, b=[1.75]), [1, 1], 0.25 / (1.75 + 2)),
        (dict(A=ONES, b=[2.25]), [1, 1], 0.25 / (2.25 + 2)),
        (dict(A=APART, b=[0.25]), [1, 1], 0.25 / (0.25 + 2)),
        (dict(G=ONES, h=[1.75]), [1, 1], 0.25 / (1.75 + 2)),
        (dict(G=ONES, h=[2.25]), [1, 1], 0),
        (dict(lb=[1.25, -INF]), [1, 1], 0.25 / (1.25 + 1)),
        (dict(ub=[INF, 0.75]), [1, 1], 0.25 / (0.75 + 1)),
        # small terms: the size is 0.1·‖x‖∞ if the right-hand side is 0, else 1e-3·‖x‖∞
        (dict(A=[[1, 0]], b=[0]), [1e-3, 2], 1e-3 / 0.2),
        (dict(A=[[1, 0]], b=[1e-6]), [2e-6, 2], 1e-6 / 2e-3),
        (dict(lb=[0, -INF]), [-1e-3, 2], 1e-3 / 0.2),
        (dict(G=[[1, 0]], h=[0]), [1e-3, 2], 1e-3 / 0.2),
        # a point that vanishes has the least length of the data, here 0.5
        (dict(A=[[1, 0]], b=[0], ub=[INF, 0.5]), [0.01, 0], 0.01 / 0.05),
        # discs: radius 1, and radius 0
        (dict(sets=[Discs([[0, 1]], [1])]), [3, 4], 4 / (1 + 5)),
        (dict(sets=[Discs([[0, 1]], [0])]), [3, 4], 1),
    ],
)
def test_a_violation_is_relative_to_the_terms_of_its_row(constraint, x, expected):
    qp = qp_of(**FREE, **constraint)
    r = kkt_residuals(qp, at(x, 0 * qp.b, 0 * qp.h))

    assert r.primal == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize(
    ("data", "s", "expected"),
    [
        # forces: ‖Px‖∞ = 1.25, r = (0, ¼)
        (dict(q=[-1, -1]), at([1, 1.25]), 0.25 / 1.25),
        # near q = 0, Px = 0, the force of a length 1 is 0.1·P₁₁·1
        (dict(q=[0, 0]), at([0, 0.01]), 0.01 / 0.1),
        (dict(q=[0, 0], lb=[-4, -INF]), at([0, 0], z_box=[-0.01, 0]), 0.01 / 0.4),
        # x = 0 is stationary with multipliers of the wrong sign, but x* = (−1, …)
        (dict(q=[1, 0], G=[[1, 0]], h=[0]), at([0, 0], z=[-1]), 1),
        (dict(q=[1, 0], ub=[0, INF]), at([0, 0], z_box=[-1, 0]), 1),
        (dict(q=[1, 0]), at([0, 0], z_box=[-1, 0]), 1),  # no bound
        # a wrong sign of 1e-6 beside a multiplier of 1, which is not a force of x
        (dict(q=[-1, 0], G=[[1, 0], [1, 0]], h=[0, 0]), at([0, 0], z=[-1e-6, 1]), 1e-6),
    ],
)
def test_an_error_of_a_force_is_relative_to_the_largest_force(data, s, expected):
    r = kkt_residuals(qp_of(np.eye(2), **data), s)

    assert r.dual == pytest.approx(expected, rel=1e-5)
    assert r.primal == 0


@pytest.mark.parametrize(
    ("data", "s"),
    [
        (dict(G=[[1]], h=[2]), at([1], z=[2])),
        (dict(ub=[2]), at([1], z_box=[2])),
        (dict(sets=[Discs([[0, 1]], [2])]), at([1, 0], z_box=[2, 0])),
    ],
)
def test_a_multiplier_of_an_inactive_limit_is_not_complementary(data, s):
    """min ½x² − 3x, x ≤ 2 at x = 1: z·slack = 2; the largest energy, |qᵀx|, is 3."""
    n = s.x.size
    r = kkt_residuals(qp_of(np.eye(n), -3 * np.eye(n)[0], **data), s)

    assert (r.primal, r.dual) == (0, 0)
    assert r[2:] == pytest.approx((2 / 3, 2 / 3))


@pytest.mark.parametrize("z", [-1.0, 1.0])
def test_the_multiplier_of_the_opposite_bound_is_refuted(z):
    """The point is stationary at one bound with the sign of the other bound."""
    x = 0.0 if z > 0 else 1.0
    r = kkt_residuals(qp_of([[1]], [-z - x], lb=0, ub=1), at([x], z_box=[z]))

    assert r.complementarity > 0.3


@pytest.mark.parametrize("tol", [1e-4, 1e-8])
@pytest.mark.parametrize("size", [1.0, 1e6, 1e12, 1e18])
def test_a_translation_of_any_size_balances_no_load(size, tol):
    """A chain of springs without support, pulled at one end, has no equilibrium."""
    P = np.diag([1.0, 2, 2, 1]) - np.eye(4, k=1) - np.eye(4, k=-1)
    qp, s = qp_of(P, [-1, 0, 0, 0]), at(np.full(4, size))

    assert verdict(Status.SOLVED, kkt_residuals(qp, s), tol) is not Verdict.VERIFIED


@pytest.mark.parametrize(
    ("data", "s"),
    [
        # x₂ occurs in no term; x₁ ≥ 1 or x₁ = 1 is violated by 1
        (dict(P=[1, 0], q=[0, 0], lb=[1, -INF]), at([0, 1e12])),
        (dict(P=[1, 0], q=[0, 0], A=[[1, 0]], b=[1]), at([0, 1e12], [0])),
        # y and z_box cancel; x₂* = 1
        (dict(P=[0, 1], q=[0, -1], A=[[1, 0]], b=[0], lb=[0, -INF]),
         at([0, 0], [1e12], [], [-1e12, 0])),
        (dict(P=[0, 1], q=[0, -1], A=[[1, 0]], b=[1], lb=[1, -INF], ub=[1, INF]),
         at([1, 100], [1e12], [], [-1e12, 0])),
        # |a|·|x| overflows
        (dict(P=[1, 1], q=[0, 0], A=[[1e200, 0]], b=[1e200]), at([0, 1e200], [0])),
    ],
    ids=["bound", "row", "gradient", "energy", "overflow"],
)  # fmt: skip
def test_large_parts_of_an_answer_do_not_hide_errors_in_others(data, s):
    qp = qp_of(**data | {"P": np.diag(data["P"])})

    assert not kkt_residuals(qp, s).worst <= 0.1
    assert diagnosis(qp, s, 1e-8)


@pytest.mark.parametrize("name", ["x", "y", "z", "z_box"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_one_component_that_is_not_finite_is_refuted(manufactured, name, value):
    qp, s = manufactured("everything", seed=271828, dense=True)
    for j in range(getattr(s, name).size):
        v = getattr(s, name).copy()
        v[j] = value
        broken = replace(s, **{name: v})
        assert verdict(Status.SOLVED, kkt_residuals(qp, broken), 1) is Verdict.WRONG
        kind = "NaN" if np.isnan(value) else "inf"
        assert diagnosis(qp, broken, 1e-8) == f"{name} contains {kind}"


def test_the_trivial_solution_of_a_trivial_problem_is_verified():
    assert kkt_residuals(qp_of([[1]], [0]), at([0])).worst == 0
    assert kkt_residuals(qp_of([[0]], [0]), at([7])).worst == 0


# --- invariances ----------------------------------------------------------------------


def in_units(qp, s, *, unit=1.0, rows=(1.0, 1.0), cost=1.0, length=1.0):
    """Return the same QP and point for x in `unit`s, rows and objective times factors.

    length : factor of all right-hand sides and bounds, of q and of x
    """
    A, G = (r[:, None] * M * unit if np.ndim(r) else r * M * unit
            for r, M in zip(rows, (qp.A, qp.G), strict=True))  # fmt: skip
    P = qp.P * cost * np.multiply.outer(unit, unit)
    scaled = QP(
        P=P, q=qp.q * cost * unit * length, A=A, b=rows[0] * qp.b * length, G=G,
        h=rows[1] * qp.h * length, lb=qp.lb / unit * length, ub=qp.ub / unit * length,
    )  # fmt: skip
    force = cost * length
    return scaled, replace(
        s, x=s.x / unit * length, y=s.y * force / rows[0], z=s.z * force / rows[1],
        z_box=s.z_box * force * unit,
    )  # fmt: skip


def disturbed(manufactured, seed):
    qp, s = manufactured("everything", seed=seed, dense=True)
    return qp, replace(
        s, x=s.x + 1e-3, y=s.y * 1.01, z=s.z - 1e-3, z_box=s.z_box * 0.99
    )


@pytest.mark.parametrize("seed", [271828, 314159])
@pytest.mark.parametrize("power", [-20, 20])
def test_units_of_the_objective_and_of_all_lengths_do_not_matter(
    manufactured, seed, power
):
    qp, s = disturbed(manufactured, seed)
    expected = pytest.approx(kkt_residuals(qp, s), rel=1e-10)

    for change in (
        dict(cost=2.0**power),
        dict(length=2.0**power),
        dict(unit=2.0**power),
    ):
        assert kkt_residuals(*in_units(qp, s, **change)) == expected


@pytest.mark.parametrize("operator", [False, True])
def test_units_of_single_rows_and_variables_hardly_matter(manufactured, operator):
    """Largest change: 0.1 decades for rows by 1e±6, 0.8 for variables by 1e±3."""
    rng = np.random.default_rng(1)
    decades = {"rows": [], "unit": []}
    for seed in range(20):
        qp, s = disturbed(manufactured, seed)
        n, m, p = s.x.size, s.y.size, s.z.size
        for name, factors in (
            ("rows", (10 ** rng.uniform(-6, 6, m), 10 ** rng.uniform(-6, 6, p))),
            ("unit", 10 ** rng.uniform(-3, 3, n)),
        ):
            pair = [(qp, s), in_units(qp, s, **{name: factors})]
            if operator and name == "rows":
                pair = [(replace(a, P=aslinearoperator(a.P)), b) for a, b in pair]
            before, after = (np.log10(kkt_residuals(*one).worst) for one in pair)
            decades[name].append(abs(after - before))

    assert max(decades["rows"]) <= 0.1
    assert np.quantile(decades["unit"], 0.9) <= 0.1
    assert max(decades["unit"]) <= 0.8


class WithDiagonal:
    def __init__(self, P):
        self.P = P

    def __call__(self, x):
        return self.P @ x

    def diagonal(self):
        return self.P.diagonal()


def test_an_operator_with_diagonal_has_the_residuals_of_its_matrix(manufactured):
    qp, s = disturbed(manufactured, 314159)

    def operator(product):
        return SerialisableOperator(qp.q.size, "it", {}, {"it": lambda _: product})

    same = replace(qp, P=operator(WithDiagonal(qp.P)))
    assert kkt_residuals(same, s) == pytest.approx(kkt_residuals(qp, s), rel=1e-12)
    assert not scaling_of(same).is_approximate
    assert replace(qp, P=operator(WithDiagonal(qp.P).__call__)).diagonal() is None


def test_an_operator_without_diagonal_has_similar_residuals_to_its_matrix(
    manufactured,
):
    """The largest eigenvalue replaces each Pⱼⱼ in the scaling; energies are equal."""
    for seed in range(10):
        qp, s = disturbed(manufactured, seed)
        other = replace(qp, P=aslinearoperator(qp.P))
        ratios = np.array(kkt_residuals(other, s)) / kkt_residuals(qp, s)
        assert ratios[2:] == pytest.approx(1)
        assert ((ratios > 0.1) & (ratios < 10)).all()
        assert scaling_of(other).is_approximate


def test_rounding_in_products_with_an_operator_does_not_refute_an_answer():
    """min ½x₁² − x₁ at its minimum; x₂ is arbitrary."""
    P = LinearOperator(
        (2, 2), matvec=lambda x: np.array([x[0], 2.0**-52 * x[0]]), dtype=float
    )
    qp = replace(qp_of(np.diag([1, 0]), [-1, 0]), P=P)

    assert kkt_residuals(qp, at([1, 1e8])).worst <= 1e-15


@pytest.mark.parametrize("d", [0, 4])
def test_the_largest_eigenvalue_may_be_zero(d):
    assert largest_eigenvalue(qp_of(np.diag([0, d]), [1, 1])) == pytest.approx(d)


# --- verdicts -------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("claimed", "worst", "expected"),
    [
        (Status.SOLVED, 9e-8, Verdict.VERIFIED),
        # the point is better than the claim
        (Status.ITERATION_LIMIT, 9e-8, Verdict.VERIFIED),
        (Status.INFEASIBLE, 9e-8, Verdict.VERIFIED),
        (Status.SOLVED, 2e-7, Verdict.INACCURATE),
        (Status.SOLVED, 3e-4, Verdict.INACCURATE),  # half of the digits: √1e-7
        (Status.SOLVED, 4e-4, Verdict.WRONG),
        (Status.SOLVED, np.nan, Verdict.WRONG),
        (Status.ITERATION_LIMIT, 2e-7, Verdict.ITERATION_LIMIT),
        (Status.INFEASIBLE, np.nan, Verdict.INFEASIBLE_CLAIM),
        (Status.UNBOUNDED, np.nan, Verdict.UNBOUNDED_CLAIM),
        (Status.FAILED, np.nan, Verdict.FAILED),
        (Status.DECLINED, 0.0, Verdict.DECLINED),
    ],
)
@pytest.mark.parametrize("place", range(4))
def test_the_verdict_follows_from_the_worst_residual(claimed, worst, expected, place):
    residuals = Residuals(*np.where(np.arange(4) == place, worst, 0))

    assert verdict(claimed, residuals, 1e-8) is expected


def stored(claimed, expected, worst=5e-8):
    return Record(
        run_id="r", case="c/f", family="c", params={}, form="f", sizes={}, solver="s",
        options={}, tol=1e-8, repeat=0, block=0, claimed=claimed, status=expected,
        **Residuals(0.0, worst, 0.0, 0.0)._asdict(),
    )  # fmt: skip


# --- diagnoses ------------------------------------------------------------------------

#: min ½‖x‖² − x₁ − x₂, x₁ + x₂ = 1, x₁ ≤ ¼, x ≥ 0: (¼, ¾), y = ¼, z = ½
QP_ = qp_of(**FREE, A=ONES, b=[1], G=[[1, 0]], h=[0.25], lb=0)
POINT = at([0.25, 0.75], [0.25], [0.5])


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, ""),
        (dict(y=[-0.25]), "with −y all residuals vanish: check the sign of y"),
        (dict(z=[-0.5]), "with −z all residuals vanish: check the sign of z"),
        (dict(y=[-0.25], z=[-0.5]),
         "with −y and −z all residuals vanish: check the sign of y and z"),
        (dict(x=[0.25, 0.85], y=[0.15], z=[0.6]),
         "row 0 is violated by 4.8e-02 of its terms"),
        (dict(x=[0.35, 0.65], y=[0.35], z=[0.3]),
         "inequality row 0 is violated by 1.7e-01 of its terms"),
        (dict(x=[-0.5, 1.5], y=[-0.5], z=[2]),
         "lower bound 0 is violated by 1.0e+00 of its terms"),
        (dict(y=[0.35]), "component 0 of Px + q + Aᵀy + Gᵀz + z_box is "
         "1.0e-01 of the largest force"),
        (dict(z=[-3]), "the sign of z[0] is wrong by 3.0e+00 of the largest force"),
        (dict(z_box=[0, 2]),
         "the sign of z_box[1] is wrong by 2.0e+00 of the largest force"),
        (dict(x=[0.125, 0.875], y=[0.125], z=[0.75]),
         "multiplier times slack of inequality row 0 is 9.4e-02 of the energy"),
        (dict(x=[0.125, 0.875], y=[0.225], z=[0.65], z_box=[0, -0.1]),
         "primal and dual objective differ by 1.7e-01 of the energy"),
    ],
)  # fmt: skip
def test_a_diagnosis_names_the_largest_error(changes, expected):
    s = replace(POINT, **{name: np.array(v, float) for name, v in changes.items()})

    assert diagnosis(QP_, s, 1e-8) == expected
    record = stored(None, Verdict.FAILED)
    assert judged(record, QP_, s).message == expected


def test_a_right_point_whose_terms_overflow_has_a_diagnosis():
    qp, s = qp_of(np.eye(2), [-1e200, 0]), at([1e200, 0])

    assert np.isnan(kkt_residuals(qp, s).gap)
    assert diagnosis(qp, s, 1e-8).startswith("primal and dual objective differ by nan")
