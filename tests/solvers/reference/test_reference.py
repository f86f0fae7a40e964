"""Reference solutions are accurate to rounding, for every shape and unit."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.linalg import aslinearoperator

from mortarbench.harness import QP, no_rows
from mortarbench.harness.conformance.manufactured import (
    SHAPES,
    infeasible,
    manufactured,
    membrane,
    one_of_each,
    unbounded,
)
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems import PROBLEMS
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.reference.equilibrate import equilibrate
from mortarbench.solvers.reference.interior import interior_point
from mortarbench.solvers.reference.polish import polish
from mortarbench.solvers.reference.solve import reference_solution

EPS = np.finfo(float).eps


def in_integers(
    *, seed, dense, n=20, m=4, p=8, rank=None, copies=0, weak=0.3, vertex=False,
    rows=0, columns=0, units=(0, 0),
):  # fmt: skip
    """Return a QP of integers times powers of two and its solution, without rounding.

    copies : number of last rows of G that repeat other rows, and of last rows of A that
        are sums of other rows (at most half of the rows of A)
    weak : probability that the multiplier of an active constraint is zero
    vertex : True puts every variable at a bound
    rows, columns : largest binary exponents of the units of rows and of variables
    units : binary exponents of the units of x and of the objective
    """
    rng = np.random.default_rng(seed)
    M = rng.integers(-4, 5, (n, n if rank is None else rank)).astype(float)
    A, G = (rng.integers(-3, 4, (k, n)).astype(float) for k in (m, p))
    active = rng.random(p) < 0.5
    for k in range(copies):
        A[m - 1 - k % (m // 2)] = A[: m // 2].sum(axis=0)
        i = k % (p - copies)
        G[p - 1 - k], active[[i, p - 1 - k]] = G[i], True
    x = rng.integers(-8, 9, n).astype(float)
    y = rng.integers(-5, 6, m).astype(float)
    z = np.where(active & (rng.random(p) > weak), rng.integers(1, 7, p), 0.0)
    side = rng.choice([-1, 1] if vertex else [-1, 0, 0, 1], n)
    z_box = side * np.where(rng.random(n) > weak, rng.integers(1, 9, n), 0.0)
    lb = np.where(side < 0, x, np.where(rng.random(n) < 0.5, x - 3, -np.inf))
    ub = np.where(side > 0, x, np.where(rng.random(n) < 0.5, x + 3, np.inf))
    fixed = np.arange(n) == 1
    q = -(M @ M.T @ x + A.T @ y + G.T @ z + z_box)
    h = G @ x + np.where(active, 0, rng.integers(1, 9, p))

    D, E, H = (
        np.ldexp(1.0, rng.integers(-most, most + 1, size))
        for most, size in ((columns, n), (rows, m), (rows, p))
    )
    length, energy = np.ldexp(1.0, units)
    X = length * D
    store = np.asarray if dense else csr_array
    qp = QP(
        P=store(energy * (M @ M.T) / X / X[:, None]), q=energy * q / X,
        A=store(E[:, None] * A / D), b=length * E * (A @ x),
        G=store(H[:, None] * G / D), h=length * H * h,
        lb=X * np.where(fixed, x, lb), ub=X * np.where(fixed, x, ub),
    )  # fmt: skip
    return qp, X * x, X


EXACT = {
    "integers": {},
    "all multipliers may vanish": dict(weak=0.7),
    "no multiplier of an inequality": dict(weak=1.0),
    "repeated rows": dict(copies=3),
    "repeated rows, some weakly active": dict(copies=3, weak=0.6),
    "more active rows than variables": dict(p=60, copies=30),
    "a vertex": dict(vertex=True, p=20, copies=8),
    "rows in units 2^±20": dict(rows=20),
    "variables in units 2^±10": dict(columns=10),
    "rows and variables in units": dict(rows=20, columns=10, copies=3),
    "x in 1e8, the objective in 1e-9": dict(units=(26, -30)),
    "x in 1e-8, the objective in 1e12": dict(units=(-26, 40)),
}


@pytest.mark.parametrize("dense", [False, True], ids=["sparse", "dense"])
@pytest.mark.parametrize("kind", EXACT.values(), ids=EXACT)
def test_a_solution_in_integers_is_found_to_the_last_digit(kind, dense):
    """Nonzero components are exact, and others have errors of at most 8e-16."""
    for seed in range(3):
        qp, x, X = in_integers(seed=seed, dense=dense, **kind)
        s = reference_solution(qp)

        assert (s.x[x != 0] == x[x != 0]).all()
        assert (abs(s.x - x) / X).max() <= 1e-16 * 8
        assert kkt_residuals(qp, s).worst <= 1e-13


@pytest.mark.parametrize("dense", [False, True], ids=["sparse", "dense"])
@pytest.mark.parametrize(
    "kind",
    [
        dict(rank=3),
        dict(rank=8, copies=3),
        dict(rank=0, m=2, p=30),
        dict(rank=0, m=2, p=30, copies=10, weak=0.6),
    ],
    ids=["singular P", "singular P, repeated rows", "no P", "no P, repeated rows"],
)
def test_one_of_many_solutions_is_found(kind, dense):
    for seed in range(11, 14):
        qp, x, _ = in_integers(seed=seed, dense=dense, **kind)
        s = reference_solution(qp)

        assert kkt_residuals(qp, s).worst <= 1e-13
        assert qp.objective(s.x) == pytest.approx(qp.objective(x), rel=1e-13)


@pytest.mark.parametrize("dense", [False, True], ids=["sparse", "dense"])
@pytest.mark.parametrize("shape", SHAPES)
def test_a_planted_point_of_every_shape_is_found_in_every_unit(shape, dense):
    """The units of x and of the objective are between 1e-8 and 1e8."""
    qp, exact = manufactured(shape, dense=dense)
    for length, energy in ((1e-8, 1e8), (1e8, 1), (1, 1e-8)):
        scaled = replace(
            qp, P=energy / length**2 * qp.P, q=energy / length * qp.q,
            b=length * qp.b, h=length * qp.h, lb=length * qp.lb, ub=length * qp.ub,
        )  # fmt: skip
        s = reference_solution(scaled)

        assert kkt_residuals(scaled, s).worst <= 2e-15
        if shape != "singular":
            assert s.x / length == pytest.approx(exact.x, rel=1e-13, abs=1e-14)


def test_every_kind_of_multiplier_has_its_sign_and_size():
    qp, exact = one_of_each()
    s = reference_solution(qp)

    for name, v in exact.items():
        assert getattr(s, name).tolist() == v.tolist()


def test_the_multipliers_of_repeated_constraints_share_the_force():
    """A bound, two rows and an equation impose x = 1 against q = −9."""
    qp = QP.from_arrays([[1]], [-9], A=[[1]], b=1, G=[[1], [2]], h=[1, 2], lb=-1, ub=1)
    s = reference_solution(qp)

    assert s.x.tolist() == [1.0]
    assert s.y + s.z @ [1, 2] + s.z_box == pytest.approx([8.0], rel=1e-15)
    assert s.z.min() >= 0
    assert s.z_box.min() >= 0


CASES = [
    ("beam-ring", dict(Nr=4, Nh=3, step=1), ("dual-bounds", "dual", "primal"), 1e-11),
    ("beam-ring", dict(Nr=4, Nh=3, contact="mortar"), ("dual-bounds", "primal"), 1e-12),
    ("contact-patch", dict(contact="nts"), ("dual", "primal"), 1e-14),
    ("contact-patch", dict(ratio=1e-3), ("dual", "primal"), 1e-11),
    ("hertz-plane", dict(n=5), ("dual", "primal"), 1e-12),
    ("hertz-cylinder", dict(n=1, m=1, contact="nts"), ("dual", "primal"), 1e-12),
    ("hertz-cylinder", dict(n=1, m=1), ("dual", "primal"), 1e-12),
    ("obstacle", dict(dim=1, n=200), ("dual-bounds", "primal"), 1e-13),
    ("obstacle", dict(dim=2, n=20), ("dual-bounds", "primal"), 1e-13),
]


def objective(qp, x):
    """Return ½xᵀPx + qᵀx in extended precision; double precision would cause an error
    of 7e-13.
    """
    P = qp.P.toarray() if hasattr(qp.P, "toarray") else np.asarray(qp.P)
    P, q, x = (v.astype(np.longdouble) for v in (P, qp.q, x))
    return x @ (P @ x) / 2 + q @ x


def rounding(qp, s):
    """Return the residual that rounding errors of x and of products with P
    may cause.
    """
    Px, size = qp.P @ s.x, abs(qp.P) @ abs(s.x)
    return 4 * EPS * max(
        size.max() / max(abs(Px).max(), abs(qp.q).max()),
        abs(s.x) @ size / abs(s.x @ Px),
    )  # fmt: skip


@pytest.mark.parametrize(
    ("name", "params", "forms", "rel"),
    [pytest.param(*case, marks=[pytest.mark.slow] * (i in (2, 5)))
     for i, case in enumerate(CASES)],
)  # fmt: skip
def test_all_forms_of_a_contact_problem_have_one_energy(name, params, forms, rel):
    """The energies agree up to the rounding errors of K and of F = BK⁺Bᵀ, which are
    largest for slender bodies and for stiff bodies on soft ones.
    """
    family, energies = PROBLEMS[name], []
    for form in forms:
        case = family.with_keys(**params).build(form, reference_solution)
        s = reference_solution(case.qp)
        energies.append(float(case.scale * objective(case.qp, s.x) + case.constant))

        assert kkt_residuals(case.qp, s).worst <= 1e-15 + rounding(case.qp, s)
        assert s.iterations is None or s.iterations <= 20
        if form != "primal":
            assert kkt_residuals(case.qp, s).worst <= 1e-15
    assert energies == pytest.approx(energies[:1] * len(forms), rel=rel)


@pytest.mark.parametrize(
    ("name", "params", "form", "energy"),
    [
        # half the work of the pressure p = 1 MPa at the displacement (1 − ν²)p/E
        ("contact-patch", {}, "primal", -0.5 * 1e6 * 1e6 * 0.91 / 10e6),
        ("contact-patch", {}, "dual", -0.5 * 1e6 * 1e6 * 0.91 / 10e6),
        # energy of the nodal interpolant of the exact height
        ("obstacle", dict(dim=1, n=12), "primal", 1 / 3 + 0.25**2 / 6),
        ("obstacle", dict(dim=1, n=12), "dual-bounds", 1 / 3 + 0.25**2 / 6),
    ],
)
def test_energies_known_by_hand_are_reached(name, params, form, energy):
    family = PROBLEMS[name]
    case = family.with_keys(**params).build(form, reference_solution)
    s = reference_solution(case.qp)

    assert case.scale * case.qp.objective(s.x) + case.constant == pytest.approx(
        energy, rel=1e-14
    )


@pytest.mark.parametrize(
    "form", ["dual-bounds", pytest.param("primal", marks=pytest.mark.slow)]
)
@pytest.mark.parametrize(
    ("steps", "tip", "force"), [(1, -0.303750, 0.0), (10, -0.297282, -2.840e7)]
)
def test_the_beam_deflects_as_in_an_independent_prototype(form, steps, tip, force):
    """For Nr = 20 and Nh = 10, there are 11 844 displacements; the load is applied in
    one step or in ten.
    """
    family = PROBLEMS["beam-ring"]
    configured = family.with_keys(Nr=20, Nh=10, steps=steps)
    case = configured.build(form, reference_solution)
    s = reference_solution(case.qp)
    quantities = case.quantities(s)

    assert kkt_residuals(case.qp, s).worst <= 1e-15 + rounding(case.qp, s)
    assert quantities["tip"][1] == pytest.approx(tip, abs=5e-7)
    assert abs(quantities["contact_force"][0]) == pytest.approx(abs(force), abs=5e3)


def test_rows_of_zeros_change_no_solution():
    qp, exact = manufactured("everything", dense=True)
    empty = np.zeros((1, 20))
    more = replace(
        qp, A=np.vstack([qp.A, empty]), b=np.append(qp.b, 0),
        G=np.vstack([qp.G, empty]), h=np.append(qp.h, 0),
    )  # fmt: skip
    s = reference_solution(more)

    assert s.x == pytest.approx(exact.x, rel=1e-14)
    assert kkt_residuals(more, s).worst <= 1e-15


@pytest.mark.parametrize("size", [1e10, 1e20, 1e100])
def test_a_far_bound_changes_no_solution(size):
    qp, exact = manufactured("some bounds")
    far = replace(
        qp, lb=np.maximum(qp.lb, -size), ub=np.minimum(qp.ub, size),
        G=csr_array(np.eye(1, 20)), h=np.array([size]),
    )  # fmt: skip

    assert reference_solution(far).x == pytest.approx(exact.x, rel=1e-14)


@pytest.mark.parametrize("noise", [1e-16, 1e-12, 1e-9, 1e-6])
def test_nearly_parallel_rows_leave_the_solution_accurate(noise):
    qp, exact = manufactured("everything", dense=True)
    wobble = 1 + noise * np.random.default_rng(31415).standard_normal(qp.G.shape)
    G = np.vstack([qp.G, qp.G * wobble])
    almost = replace(qp, G=G, h=np.append(qp.h, qp.h))
    s = reference_solution(almost)

    assert kkt_residuals(almost, s).worst <= max(1e-15, 1e-3 * noise)
    assert s.x == pytest.approx(exact.x, abs=100 * noise + 1e-14)


@pytest.mark.parametrize("digits", [6, 12, 18])
def test_ill_conditioning_costs_no_digit_of_the_residuals(digits):
    rng = np.random.default_rng(2718)
    Q = np.linalg.qr(rng.standard_normal((40, 40)))[0]
    P = Q * np.logspace(0, -digits, 40) @ Q.T
    x = np.where(np.arange(40) % 2, rng.exponential(size=40), 0.0)
    pushed = np.where(x == 0, rng.exponential(size=40), 0.0)
    A = rng.standard_normal((3, 40))
    qp = QP.from_arrays((P + P.T) / 2, pushed - P @ x, A=A, b=A @ x, lb=0)

    assert kkt_residuals(qp, reference_solution(qp)).worst <= 1e-13


def test_few_iterations_identify_the_active_set_and_one_factor_is_enough_to_refine():
    qp = equilibrate(membrane(40)).qp
    start = interior_point(qp)
    points = list(polish(qp, start))

    assert start.iterations <= 15
    assert 1e-15 < kkt_residuals(qp, start).worst <= 1e-11
    assert len(points) == 1
    assert kkt_residuals(qp, points[0]).complementarity == 0


def test_a_wrong_active_set_is_corrected():
    """The solve for a membrane on an obstacle starts from x = 0 without active
    constraints.
    """
    qp = equilibrate(membrane(12)).qp
    exact = reference_solution(qp)
    start = replace(exact, x=0 * exact.x, z_box=0 * exact.x)
    *_, last = polish(qp, start)

    assert (exact.z_box < 0).sum() > 10
    assert last.x == pytest.approx(exact.x, rel=1e-15)


def test_the_scaled_qp_has_entries_of_about_one_and_the_same_points():
    qp, x, _ = in_integers(seed=1, dense=False, rows=20, columns=10, units=(26, -30))
    scaled = equilibrate(qp)
    s = reference_solution(scaled.qp)

    for M in (scaled.qp.P, scaled.qp.A, scaled.qp.G):
        assert 0.5 <= abs(M).max() <= 2
    for M in (scaled.qp.A, scaled.qp.G):
        assert abs(M).max(axis=1).toarray().min() >= 0.25
    assert (scaled.recover(s).x[x != 0] == x[x != 0]).all()
    assert kkt_residuals(qp, scaled.recover(s)).worst <= 1e-13


def test_a_large_operator_is_refused_in_one_line_and_a_small_one_multiplied_out():
    qp, point = manufactured("box")
    s = reference_solution(replace(qp, P=aslinearoperator(qp.P)))
    assert s.x == pytest.approx(point.x)

    qp, _ = manufactured("box", n=801)
    with pytest.raises(ValueError, match="needs P as a matrix; got an operator") as e:
        reference_solution(replace(qp, P=aslinearoperator(qp.P)))
    assert "\n" not in str(e.value)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_matrix_with_nan_or_inf_is_refused_in_one_line(bad):
    qp, _ = manufactured("bounds", dense=True)

    with pytest.raises(ValueError, match="needs finite matrices"):
        reference_solution(replace(qp, P=np.where(np.eye(20) == 1, bad, qp.P)))


def contradicting():
    """Return a QP with the equations x₀ = 1 and x₀ = 2."""
    qp, _ = manufactured("unconstrained")
    return replace(qp, A=csr_array(np.eye(20)[[0, 0]]), b=np.array([1.0, 2.0]))


def crossing():
    """Return a QP with x₀ ≤ −1 by a row and x₀ ≥ 0 by a bound."""
    qp, _ = manufactured("bounds", dense=True)
    return replace(qp, G=np.eye(1, 20), h=-np.ones(1), lb=np.zeros(20))


def falling():
    """Return an unconstrained QP with a nonzero gradient and zero curvature."""
    qp = membrane(4)
    return replace(qp, P=0 * qp.P, lb=np.full(16, -np.inf))


@pytest.mark.parametrize(
    "make", [infeasible, unbounded, contradicting, crossing, falling]
)
def test_a_qp_without_a_solution_raises(make):
    with pytest.raises(ArithmeticError, match="found no optimal point") as e:
        reference_solution(make())
    assert "\n" not in str(e.value)


def test_a_qp_whose_variables_are_all_fixed_is_solved():
    s = reference_solution(QP.from_arrays(np.eye(2), [1, 1], lb=1, ub=1))

    assert s.x.tolist() == [1, 1]
    assert s.z_box.tolist() == [-2, -2]


def test_the_reference_uses_no_other_solver():
    """`lint-imports` holds that it imports no other package of solvers/."""
    code = (
        "import sys; from mortarbench.harness.conformance import manufactured as m;"
        "from mortarbench.solvers.reference.solve import reference_solution as solve;"
        "[solve(m.manufactured(s)[0]) for s in ('everything', 'singular', 'bounds')];"
        "print(*{name.partition('.')[0] for name in sys.modules})"
    )
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    libraries = {s.about.module or s.about.package for s in SOLVERS.values()}

    assert {"clarabel", "cvxpy"} <= libraries
    assert libraries.isdisjoint(run.stdout.decode().split())


def test_a_qp_without_variables_has_the_empty_solution():
    """Such QPs arise if no sides can touch; SciPy's nnls would fail on them."""
    nothing = np.zeros(0)
    qp = QP(
        P=np.zeros((0, 0)), q=nothing, A=no_rows(0), b=nothing, G=no_rows(0),
        h=nothing, lb=nothing, ub=nothing,
    )  # fmt: skip

    assert reference_solution(qp).x.size == 0
