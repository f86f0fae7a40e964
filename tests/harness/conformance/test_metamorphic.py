"""Each change is an equivalent formulation, and its inverse map recovers solutions."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse.linalg import aslinearoperator

from mortarbench.harness import QP, Solution, Status, verdict
from mortarbench.harness.conformance.equivalence import CHANGES, CHANGES_OF
from mortarbench.harness.conformance.manufactured import FORMS, SHAPES, strings
from mortarbench.harness.conformance.metamorphic import (
    change_units,
    duplicate_rows,
    mirror,
    permute_rows,
    permute_unknowns,
    scale_rows,
    shift_unknowns,
)
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.solvers.adapters.piqp_ import PIQP


def generator():
    return np.random.default_rng(161803)


#: changes that preserve every residual at every point
NAMES_AND_UNITS = {
    "units": lambda qp: change_units(qp, unknown=2.0**-11, objective=2.0**28),
    "odd units": lambda qp: change_units(qp, unknown=0.0254, objective=4.448),
    "unknowns permuted": lambda qp: permute_unknowns(
        qp, generator().permutation(qp.q.size)
    ),
    "rows permuted": lambda qp: permute_rows(
        qp, generator().permutation(qp.b.size), generator().permutation(qp.h.size)
    ),
    "rows scaled": lambda qp: scale_rows(
        qp,
        2.0 ** generator().integers(-9, 9, qp.b.size),
        2.0 ** generator().integers(-9, 9, qp.h.size),
    ),
    "mirrored": lambda qp: mirror(qp, generator().random(qp.q.size) < 0.5),
}
TRANSFORMS = NAMES_AND_UNITS | {
    "rows twice": lambda qp: duplicate_rows(
        qp, np.arange(0, qp.b.size, 2), generator().random(qp.h.size) < 0.5
    ),
    "unknowns shifted": lambda qp: shift_unknowns(
        qp, generator().integers(-8, 8, qp.q.size) / 8
    ),
    "all": lambda qp: (
        TRANSFORMS["units"](qp)
        .followed_by(TRANSFORMS["unknowns shifted"])
        .followed_by(TRANSFORMS["unknowns permuted"])
        .followed_by(TRANSFORMS["mirrored"])
        .followed_by(TRANSFORMS["rows twice"])
        .followed_by(TRANSFORMS["rows scaled"])
    ),
}

every_transform = pytest.mark.parametrize("transform", TRANSFORMS)
every_shape = pytest.mark.parametrize("shape", SHAPES)


def random_point(qp):
    """Return a random point with multipliers of any sign, also for absent bounds."""
    rng = generator()
    x, y, z, z_box = (rng.standard_normal(v.size) for v in (qp.q, qp.b, qp.h, qp.q))
    return Solution(status=Status.SOLVED, x=x, y=y, z=z, z_box=z_box)


def lagrangian(qp, s):
    """Return objective + yᵀ(Ax − b) + zᵀ(Gx − h) + terms of finite bounds."""
    box = np.where(s.z_box > 0, s.x - qp.ub, s.x - qp.lb)
    box = s.z_box @ np.where(np.isfinite(box), box, 0)
    return (
        qp.objective(s.x) + s.y @ (qp.A @ s.x - qp.b) + s.z @ (qp.G @ s.x - qp.h) + box
    )


@pytest.mark.parametrize(
    ("transform", "dense"),
    [
        pytest.param(
            transform, dense, id=f"{transform}-{'dense' if dense else 'sparse'}",
            marks=[pytest.mark.slow] * (dense and transform != "all"),
        )
        for transform in TRANSFORMS
        for dense in (False, True)
    ],
)  # fmt: skip
@every_shape
def test_the_map_back_recovers_the_solution(manufactured, transform, shape, dense):
    """The solution of the changed QP is mapped to the minimiser, if it is unique."""
    qp, expected = manufactured(shape, dense=dense)
    new = TRANSFORMS[transform](qp)
    s = PIQP().prepare(new.qp, 1e-11)()
    back = new.recover(s)

    assert kkt_residuals(new.qp, s).worst <= 1e-9
    assert kkt_residuals(qp, back).worst <= 1e-8
    value = new.scale * new.qp.objective(s.x) + new.constant
    assert value == pytest.approx(qp.objective(expected.x), rel=1e-7)
    if shape != "singular":
        assert back.x == pytest.approx(expected.x, abs=1e-6)
    if shape not in ("singular", "redundant"):  # multipliers are unique
        for name in ("y", "z"):
            assert getattr(back, name) == pytest.approx(
                getattr(expected, name), abs=1e-6
            )


@every_transform
@every_shape
def test_objective_and_lagrangian_keep_their_relation_at_every_point(
    manufactured, transform, shape
):
    qp, _ = manufactured(shape, dense=True)
    new = TRANSFORMS[transform](qp)
    s = random_point(new.qp)
    back = new.recover(s)

    for value in (lambda q, at: q.objective(at.x), lagrangian):
        changed = new.scale * value(new.qp, s) + new.constant
        assert changed == pytest.approx(value(qp, back), rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("transform", NAMES_AND_UNITS)
@every_shape
def test_violated_constraints_stay_violated(manufactured, transform, shape):
    """Test rows, bounds and signs of multipliers at a random point."""

    def violated(qp, s):
        z_lb, z_ub = s.z_box < 0, s.z_box > 0
        bounds = (s.x < qp.lb).sum() + (s.x > qp.ub).sum()
        absent = (z_lb & np.isinf(qp.lb)).sum() + (z_ub & np.isinf(qp.ub)).sum()
        return (qp.G @ s.x > qp.h).sum(), (s.z < 0).sum(), bounds, absent

    qp, _ = manufactured(shape, dense=True)
    new = NAMES_AND_UNITS[transform](qp)
    s = random_point(new.qp)

    assert violated(new.qp, s) == violated(qp, new.recover(s))


@pytest.mark.parametrize("transform", NAMES_AND_UNITS)
@every_shape
def test_names_and_units_change_no_residual_at_any_point(
    manufactured, transform, shape
):
    """Residuals are invariant at good points, at bad points and for NaN."""
    qp, expected = manufactured(shape, dense=True)
    new = NAMES_AND_UNITS[transform](qp)
    inverse = preimage(qp, new)
    near = replace(
        expected, x=expected.x + 1e-5 * generator().standard_normal(qp.q.size)
    )
    for old in (
        random_point(qp),
        near,
        expected,
        Solution.without_point(qp, Status.SOLVED),
    ):
        s = inverse(old)
        got, promised = kkt_residuals(new.qp, s), kkt_residuals(qp, old)
        assert got == pytest.approx(promised, rel=1e-9, abs=1e-14, nan_ok=True)
        for tol in (1e-3, 1e-8):
            judged = [verdict(Status.SOLVED, r, tol) for r in (got, promised)]
            assert judged[0] is judged[1]


def preimage(qp, new):
    """Return the inverse of the affine map `new.recover`.

    The map is found from its values at zero and at the unit vectors.
    """
    parts = ("x", "y", "z", "z_box")
    sizes = [new.qp.q.size, new.qp.b.size, new.qp.h.size, new.qp.q.size]
    cuts = np.cumsum(sizes)[:-1]

    def back(v):
        s = Solution(
            status=Status.SOLVED, **dict(zip(parts, np.split(v, cuts), strict=True))
        )
        s = new.recover(s)
        return np.concatenate([getattr(s, name) for name in parts])

    zero = back(np.zeros(sum(sizes)))
    columns = np.array([back(e) - zero for e in np.eye(sum(sizes))]).T
    to = abs(columns).argmax(axis=0)  # one entry in each row and column
    entry = columns[to, np.arange(to.size)]

    def there(old):
        v = np.concatenate([getattr(old, name) for name in parts])
        return replace(
            old, **dict(zip(parts, np.split((v - zero)[to] / entry, cuts), strict=True))
        )

    return there


@every_shape
def test_a_duplicated_row_changes_residuals_by_a_factor_of_two_at_most(
    manufactured, shape
):
    """Each multiplier is halved, so only z⁻ and zᵢ·slackᵢ decrease, by a
    factor of two.
    """
    qp, _ = manufactured(shape, dense=True)
    new = duplicate_rows(qp, np.arange(qp.b.size), np.arange(qp.h.size))
    old = random_point(qp)
    s = replace(old, y=np.tile(old.y / 2, 2), z=np.tile(old.z / 2, 2))
    got, before = kkt_residuals(new.qp, s), kkt_residuals(qp, old)

    assert new.recover(s).z == pytest.approx(old.z)
    assert (got.primal, got.gap) == pytest.approx((before.primal, before.gap))
    for name in ("dual", "complementarity"):
        whole = getattr(before, name)
        assert 0.5 * whole <= getattr(got, name) * (1 + 1e-12) <= whole * (1 + 1e-11)


@pytest.mark.parametrize("transform", ["units", "rows scaled", "mirrored"])
def test_powers_of_two_are_exact(manufactured, transform):
    qp, _ = manufactured("everything")
    new = TRANSFORMS[transform](qp).qp
    for name in ("P", "q", "A", "b", "G", "h", "lb", "ub"):
        old, got = (getattr(p, name) for p in (qp, new))
        old, got = (
            abs(v.toarray() if hasattr(v, "toarray") else v) for v in (old, got)
        )
        if transform == "mirrored" and name in ("lb", "ub"):
            continue
        assert (np.frexp(old)[0] == np.frexp(got)[0]).all()


@pytest.mark.parametrize("form", ["dual", "dual-bounds"])
@pytest.mark.parametrize("transform", TRANSFORMS)
def test_the_structure_of_a_dual_is_that_of_the_changed_dual(form, transform):
    """P' = B'K'⁺B'ᵀ, with K' restricted to the components that are not fixed."""
    new = TRANSFORMS[transform](strings(form)).qp
    K, B = new.structure.K.toarray(), new.structure.B.toarray()
    free = np.setdiff1d(np.arange(len(K)), new.structure.fixed)
    B = B[:, free]
    F = B @ np.linalg.pinv(K[np.ix_(free, free)], hermitian=True) @ B.T

    assert new.P == pytest.approx(F, abs=1e-12 * abs(F).max())


def test_units_of_the_strings_are_those_of_textbooks():
    """For the same body, K is in Pa, MPa or GPa, and λ in N/m, N/mm or GN/m."""
    nd = strings("primal").P.toarray().max()
    pascal = nd * 2.0**26  # F₀/l
    for units, factor in [("N, m", 1), ("N, mm", 2.0**-20), ("GN, m", 2.0**-30)]:
        primal = CHANGES[f"units {units}"](strings("primal"), "primal")
        assert primal.qp.P.toarray().max() == pascal * factor
    dual = strings("dual-bounds")
    metre = CHANGES["units N, m"](dual, "dual-bounds").qp
    mm = CHANGES["units N, mm"](dual, "dual-bounds").qp
    assert metre.q == pytest.approx(dual.q * 2)  # a gap in m
    assert mm.q == pytest.approx(metre.q * 1024)  # and in mm
    assert mm.P == pytest.approx(metre.P * 2.0**20)  # 1/Pa and 1/MPa


def test_the_three_forms_of_the_strings_are_one_problem():
    """λ_I is the multiplier of the contact rows, and strong duality holds."""
    points = {form: PIQP().prepare(strings(form), 1e-11)() for form in FORMS}
    pressures = points["primal"].z
    assert (pressures > 1e-4).sum() == 9
    assert points["dual"].x[4:] == pytest.approx(pressures, abs=1e-8)
    assert points["dual-bounds"].x == pytest.approx(pressures, abs=1e-8)

    primal = strings("primal")
    u = points["primal"].x
    load = np.linalg.pinv(primal.P.toarray(), hermitian=True) @ primal.q
    dual = strings("dual").objective(points["dual"].x)
    assert primal.objective(u) == pytest.approx(-dual - 0.5 * primal.q @ load, rel=1e-9)


@pytest.mark.parametrize("form", FORMS)
def test_each_change_of_a_form_changes_its_data(form):
    qp = strings(form)
    for change in CHANGES_OF[form][1:]:
        new = CHANGES[change](qp, form).qp
        assert new.h.size != qp.h.size or new.b.size != qp.b.size or not same(qp, new)


def same(a: QP, b: QP):
    return all(
        np.array_equal(
            *(v.toarray() if hasattr(v, "toarray") else v
              for v in (getattr(a, name), getattr(b, name)))
        )
        for name in ("P", "q", "A", "b", "G", "h", "lb", "ub")
    )  # fmt: skip


def test_an_operator_is_refused_by_changes_of_its_unknowns(manufactured):
    qp, _ = manufactured("bounds")
    with pytest.raises(ValueError, match="expected a matrix"):
        mirror(replace(qp, P=aslinearoperator(qp.P)), [0])
