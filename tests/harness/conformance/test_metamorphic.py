"""Each change is an equivalent formulation, and its inverse map recovers solutions."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse.linalg import aslinearoperator

from mortarbench.harness import Solution, Status
from mortarbench.harness.conformance.manufactured import SHAPES
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
    [*((transform, False) for transform in TRANSFORMS), ("all", True)],
)
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


def test_an_operator_is_refused_by_changes_of_its_unknowns(manufactured):
    qp, _ = manufactured("bounds")
    with pytest.raises(ValueError, match="expected a matrix"):
        mirror(replace(qp, P=aslinearoperator(qp.P)), [0])
