"""The mapped solution of a QP solves every equivalent QP."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse.linalg import aslinearoperator

from mortarbench.harness.conformance.manufactured import SHAPES
from mortarbench.harness.conformance.metamorphic import (
    CHANGES,
    UNITS,
    change_units,
    mirror,
    permute_rows,
    permute_unknowns,
    scale_rows,
    shift_unknowns,
)
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.harness.verify.multipliers import with_multipliers
from mortarbench.solvers.adapters.piqp_ import PIQP


def generator():
    return np.random.default_rng(161803)


def powers(size):
    return 2.0 ** generator().integers(-9, 9, size)


#: changes, with the map of points to those of the changed QP
TRANSFORMS = {
    "units": (
        lambda qp: change_units(qp, unknown=0.0254, objective=4.448),
        lambda x: x / 0.0254,
    ),
    "unknowns permuted": (
        lambda qp: permute_unknowns(qp, generator().permutation(qp.q.size)),
        lambda x: x[generator().permutation(x.size)],
    ),
    "rows permuted and repeated": (
        lambda qp: permute_rows(
            qp, np.arange(qp.b.size)[::-1], np.tile(np.arange(qp.h.size), 2)
        ),
        lambda x: x,
    ),
    "rows scaled": (
        lambda qp: scale_rows(qp, powers(qp.b.size), powers(qp.h.size)),
        lambda x: x,
    ),
    "mirrored": (
        lambda qp: mirror(qp, generator().random(qp.q.size) < 0.5),
        lambda x: np.where(generator().random(x.size) < 0.5, -x, x),
    ),
    "unknowns shifted": (
        lambda qp: shift_unknowns(qp, generator().integers(-8, 8, qp.q.size) / 8),
        lambda x: x - generator().integers(-8, 8, x.size) / 8,
    ),
}


@pytest.mark.parametrize("dense", [False, True])
@pytest.mark.parametrize("transform", TRANSFORMS)
@pytest.mark.parametrize("shape", SHAPES)
def test_the_mapped_solution_and_no_other_point_solves_the_changed_qp(
    manufactured, transform, shape, dense
):
    qp, s = manufactured(shape, dense=dense)
    change, to_new = TRANSFORMS[transform]
    new = change(qp)

    def error(x):
        return kkt_residuals(new, with_multipliers(new, to_new(x))).worst

    assert error(s.x) <= 1e-11
    # "singular" has further solutions in the kernel of P
    assert shape == "singular" or error(1.001 * s.x) > 1e-6


@pytest.mark.parametrize("transform", TRANSFORMS)
@pytest.mark.parametrize("shape", SHAPES)
def test_differences_of_the_objective_keep_their_ratio(manufactured, transform, shape):
    qp, s = manufactured(shape, dense=True)
    change, to_new = TRANSFORMS[transform]
    other = generator().standard_normal(s.x.size)
    old, new = (
        of.objective(to(s.x)) - of.objective(to(other))
        for of, to in ((qp, lambda x: x), (change(qp), to_new))
    )
    assert new == pytest.approx(old * (4.448 if transform == "units" else 1), rel=1e-9)


@pytest.mark.parametrize("change", CHANGES)
def test_the_changed_qp_has_the_optimal_value_of_the_original(manufactured, change):
    """The shift of all unknowns by ½ is the only change that adds a constant."""
    qp, s = manufactured("everything")
    new = CHANGES[change](qp)
    found = PIQP().prepare(new, 1e-11)()
    half = np.full(qp.q.size, 0.5 * (change == "unknowns shifted"))
    force, length = UNITS.get(change.removeprefix("units "), (1.0, 1.0))
    value = new.objective(found.x) / (force * length) + qp.objective(half)

    assert kkt_residuals(new, found).worst <= 1e-9
    assert value == pytest.approx(qp.objective(s.x), rel=1e-7)


def test_an_operator_is_refused_by_changes_of_its_unknowns(manufactured):
    qp, _ = manufactured("bounds")
    with pytest.raises(ValueError, match="expected a matrix"):
        mirror(replace(qp, P=aslinearoperator(qp.P)), [0])
