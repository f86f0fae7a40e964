"""The paper's benchmark against counts, an independent code and the equations."""

from dataclasses import replace

import numpy as np
import pytest

from harness import InputError, kkt_residuals
from problems.beam_ring import BeamRing, model
from solvers.clarabel_ import Clarabel
from solvers.osqp_ import OSQP
from solvers.proxqp_ import ProxQP
from solvers.reference import reference_solution
from solvers.smalbe import SMALBE

FAMILY = BeamRing()


def build(form, **given):
    return FAMILY.build(form, FAMILY.complete(given), reference_solution)


def physical(case, solver, tol):
    s = solver.prepare(case.qp, tol)()
    assert kkt_residuals(case.qp, s).worst <= 10 * tol
    return case.quantities(s), case.scale * case.qp.objective(s.x) + case.constant


def test_counts_of_table_1():
    bodies = model(30, 15, 30, "strain")
    beam, (pair,) = bodies.body == 0, bodies.pairs

    assert len(bodies.mesh.points) == 7471 + 5611 == 13082
    assert (beam.sum(), (~beam).sum()) == (7200, 5400)
    assert bodies.mesh.dofs == 14942 + 11222 == 26164
    assert (len(pair.master) - 1, len(pair.slave) - 1) == (240, 180)
    assert bodies.B_D.shape[0] == 186


@pytest.mark.parametrize(("radial", "nodes"), [(6, 424), (3, 313)])
def test_the_papers_313_nodes_belong_to_half_as_many_radial_layers(radial, nodes):
    """Erratum: text and Table 1 mean 2·Nh layers, Figure 2 was drawn with Nh."""
    assert len(model(4, 3, radial, "strain").mesh.points) == nodes


def test_radial_defaults_to_twice_Nh_and_step_to_the_last():
    params = FAMILY.complete({"Nh": 7, "steps": 4})

    assert (params["radial"], params["step"]) == (14, 4)


ORACLE = {"tip": [0.03884621, -0.29506529], "sum": 1.855250e8, "rows": 37, "active": 5}


@pytest.mark.parametrize(
    ("form", "solver"),
    [("dual", SMALBE()), ("dual-bounds", SMALBE()),
     ("primal", Clarabel()), ("dual", Clarabel())],
    ids=["smalbe-dual", "smalbe-dual-bounds", "clarabel-primal", "clarabel-dual"],
)  # fmt: skip
def test_one_linearisation_has_the_digits_of_an_independent_code(form, solver):
    """The digits are those of nodal contact in GetFEM 5.4 on the same meshes."""
    result, _ = physical(build(form, Nr=4, Nh=3, steps=1), solver, 1e-9)

    assert result["tip"] == pytest.approx(ORACLE["tip"], abs=5e-9)
    assert result["multiplier_sum"] == pytest.approx(ORACLE["sum"], rel=5e-7)
    assert (result["contact_rows"], result["active"]) == (37, 5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("form", "solver", "tol"),
    [("dual", SMALBE(), 1e-9), ("dual-bounds", SMALBE(), 1e-9),
     ("dual", OSQP(), 1e-9), ("primal", OSQP(), 1e-9),
     ("dual", ProxQP(), 1e-9), ("primal", ProxQP(), 1e-9),
     # an interior point keeps λ > 10⁻⁶ max λ on nearly touching rows until 1e-11
     ("dual", Clarabel(), 1e-11), ("primal", Clarabel(), 1e-11)],
    ids=lambda value: value if isinstance(value, str) else type(value).__name__,
)  # fmt: skip
def test_ten_steps_on_the_papers_largest_mesh(form, solver, tol):
    result, energy = physical(build(form, Nr=30, Nh=15), solver, tol)

    assert result["tip"] == pytest.approx([0.04102, -0.29791], abs=5e-6)
    assert (result["active"], result["contact_rows"]) == (24, 181)
    assert result["energy"] == pytest.approx(-1.67787364e7, rel=1e-7)
    assert energy == pytest.approx(-1.67787364e7, rel=1e-7)


@pytest.mark.parametrize("plane", ["strain", "stress"])
def test_every_form_gives_the_same_displacement_energy_and_multipliers(plane):
    """And the recovered points satisfy the KKT conditions of the primal problem."""
    given = dict(Nr=4, Nh=3, steps=3, step=2, plane=plane)
    cases = {form: build(form, **given) for form in FAMILY.forms}
    bounds = reference_solution(cases["dual-bounds"].qp)
    dual = SMALBE().prepare(cases["dual"].qp, 1e-12)()
    u = cases["dual-bounds"].recover(bounds)

    assert cases["dual"].recover(dual) == pytest.approx(u, abs=1e-9 * abs(u).max())
    expected = cases["dual-bounds"].quantities(bounds)
    for form, s in (("dual", dual), ("dual-bounds", bounds)):
        case, got = cases[form], cases[form].quantities(s)
        energy = case.scale * case.qp.objective(s.x) + case.constant
        assert energy == pytest.approx(expected["energy"], rel=1e-9)
        assert got["energy"] == pytest.approx(expected["energy"], rel=1e-9)
        assert got["contact_force"] == pytest.approx(
            expected["contact_force"], rel=1e-7
        )
    assert cases["primal"].qp.objective(u / 2.0) * 2e8 == pytest.approx(
        expected["energy"], rel=1e-9
    )


def test_forces_are_in_equilibrium():
    """Load, contact force and the clamp's reaction balance on the beam."""
    case = build("dual", Nr=4, Nh=3, steps=2)
    s = SMALBE().prepare(case.qp, 1e-11)()
    bodies = model(4, 3, 6, "strain")
    reaction = -s.x[: bodies.B_D.shape[0]] @ bodies.B_D
    on_beam = (bodies.body_of_node == 0).repeat(2)
    result = case.quantities(s)

    total = np.array([reaction[on_beam][i::2].sum() for i in (0, 1)]) * 1e8
    assert total + result["contact_force"] == pytest.approx([0, 1e8], abs=1)


def test_no_contact_no_force():
    """Lifted by its load, the beam leaves the ring alone: λ_I = 0 exactly."""
    case = build("dual-bounds", Nr=4, Nh=3, steps=1)
    primal = build("primal", Nr=4, Nh=3, steps=1)
    gaps = primal.qp.h
    lifted = replace(case.qp, q=2 * gaps - case.qp.q)  # load reversed: c − B K⁻¹(−f)

    assert (gaps > 0).all()
    assert (reference_solution(lifted).x == 0).all()


def test_the_load_of_a_step_is_its_share():
    full, half = (build("primal", Nr=4, Nh=3, steps=4, step=k).qp.q for k in (4, 2))

    assert half == pytest.approx(full / 2)
    assert abs(full).max() == pytest.approx(1)


def test_relinearisation_closes_the_gap_that_load_steps_leave():
    """Re-linearised five times, one load step is consistent with itself: the rows at
    its own solution are those that it was solved with. Ten plain steps are not."""

    def mismatch(**given):
        last = build("primal", Nr=10, Nh=5, **given)
        again = build("primal", Nr=10, Nh=5, **given | {"relin": given["relin"] + 1})
        return abs(last.qp.G - again.qp.G).max()

    assert mismatch(steps=1, relin=7) < 1e-5 < mismatch(steps=10, relin=1)


@pytest.mark.parametrize(
    ("bad", "told"),
    [
        ({"Nr": 0}, "Nr=0 must be at least 1"),
        ({"steps": 3, "step": 4}, "step=4 must be in 1..steps=3"),
        (
            {"plane": "curved"},
            "plane='curved' is unknown, expected 'strain' or 'stress'",
        ),
    ],
)
def test_values_out_of_range_are_refused_with_the_right_ones(bad, told):
    with pytest.raises(InputError, match="beam-ring: ") as e:
        FAMILY.check(FAMILY.complete(bad))

    assert told in str(e.value)
