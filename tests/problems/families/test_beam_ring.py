"""The benchmark of the paper, compared with its counts and with independent codes."""

from dataclasses import replace

import numpy as np
import pytest

from mortarbench.harness.suite.suite import load_suite
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.problems import PROBLEMS
from mortarbench.problems.duality.monolithic import monolithic_path
from mortarbench.problems.families.beam_ring import BeamRing, model
from mortarbench.registries import suites_folder
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.adapters.clarabel_ import Clarabel
from mortarbench.solvers.adapters.osqp_ import OSQP
from mortarbench.solvers.adapters.proxqp_ import ProxQP
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe.solver import SMALBE

FAMILY = BeamRing()


def build(form, **keys):
    return FAMILY.with_keys(**keys).build(form, reference_solution)


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
    """The text and Table 1 of the paper imply 2·Nh radial layers; its Figure 2 shows
    Nh."""
    assert len(model(4, 3, radial, "strain").mesh.points) == nodes


def test_radial_defaults_to_twice_Nh_and_step_to_the_last():
    family = BeamRing(Nh=7, steps=4)

    assert (family.radial, family.step) == (14, 4)


ORACLE = {"tip": [0.03884621, -0.29506529], "sum": 1.855250e8, "rows": 37, "active": 5}


@pytest.mark.parametrize("solver", [SMALBE(), Clarabel(), OSQP(), ProxQP()], ids=repr)
@pytest.mark.parametrize("form", FAMILY.forms)
def test_one_linearisation_has_the_digits_of_an_independent_code(form, solver):
    """The expected digits are those of nodal contact in GetFEM 5.4 on the same
    meshes."""
    case = build(form, Nr=4, Nh=3, steps=1)
    if solver.declines(case.qp):
        assert (form, type(solver)) == ("primal", SMALBE)
        return
    result, _ = physical(case, solver, 1e-9)

    assert result["tip"] == pytest.approx(ORACLE["tip"], abs=5e-9)
    assert result["multiplier_sum"] == pytest.approx(ORACLE["sum"], rel=5e-7)
    assert (result["contact_rows"], result["active"]) == (37, 5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("form", "solver", "tol"),
    [("dual", SMALBE(), 1e-9), ("dual-bounds", SMALBE(), 1e-9),
     ("dual", OSQP(), 1e-9), ("primal", OSQP(), 1e-9),
     ("dual", ProxQP(), 1e-9), ("primal", ProxQP(), 1e-9),
     # interior-point methods have λ ≤ 10⁻⁶ max λ on open rows only at 1e-10
     ("dual", Clarabel(), 1e-10), ("primal", Clarabel(), 1e-10)],
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
    """The dual forms have equal displacements, energies and contact forces, and the
    primal objective at their displacement is the same energy."""
    keys = dict(Nr=4, Nh=3, steps=3, step=2, plane=plane)
    cases = {form: build(form, **keys) for form in FAMILY.forms}
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


def test_load_steps_do_not_depend_on_the_order_of_requests():
    orders = [(5, 2, 4), (2, 4, 5)]
    seen = []
    for order in orders:
        monolithic_path.cache_clear()
        seen.append(
            {k: build("primal", Nr=4, Nh=3, steps=5, step=k).qp.h for k in order}
        )

    for k in (2, 4, 5):
        assert (seen[0][k] == seen[1][k]).all()
    assert abs(seen[0][2] - seen[0][4]).max() > 1e-3


def test_results_are_those_of_each_body_and_of_the_rows_that_push():
    case = build("dual-bounds", Nr=4, Nh=3, steps=1)
    s = reference_solution(case.qp)
    result, state = case.quantities(s), case.fields(s)
    stress = state.nodal["von_mises"]
    planted = np.zeros(37)
    planted[:3] = [1.0, 2e-6, 5e-7]  # the threshold is 10⁻⁶ of the largest

    assert result["max_von_mises"]["beam"] == stress[:165].max()
    assert result["max_von_mises"]["ring"] == stress[165:].max()
    assert case.quantities(replace(s, x=planted))["active"] == 2


def test_an_inaccurate_reference_defines_no_case():
    def lying(qp):
        return replace(reference_solution(qp), x=np.zeros(qp.q.size))

    with pytest.raises(ArithmeticError, match="reference solve at load factor"):
        FAMILY.with_keys(Nr=4, Nh=3, steps=2).build("primal", lying)


def test_forces_are_in_equilibrium():
    """On the beam, the load, the contact force and the reactions of the clamp
    balance."""
    case = build("dual", Nr=4, Nh=3, steps=2)
    s = SMALBE().prepare(case.qp, 1e-11)()
    bodies = model(4, 3, 6, "strain")
    reaction = -s.x[: bodies.B_D.shape[0]] @ bodies.B_D
    on_beam = (bodies.body_of_node == 0).repeat(2)
    result = case.quantities(s)

    total = np.array([reaction[on_beam][i::2].sum() for i in (0, 1)]) * 1e8
    assert total + result["contact_force"] == pytest.approx([0, 1e8], abs=1)


def test_without_contact_there_is_no_contact_force():
    """Under an upward load, the beam does not touch the ring, and λ_I = 0 exactly."""
    case = build("dual-bounds", Nr=4, Nh=3, steps=1)
    primal = build("primal", Nr=4, Nh=3, steps=1)
    gaps = primal.qp.h
    lifted = replace(case.qp, q=2 * gaps - case.qp.q)  # reversed load: c − B K⁻¹(−f)

    assert (gaps > 0).all()
    assert (reference_solution(lifted).x == 0).all()


def test_the_load_of_a_step_is_its_fraction_of_the_full_load():
    full, half = (build("primal", Nr=4, Nh=3, steps=4, step=k).qp.q for k in (4, 2))

    assert half == pytest.approx(full / 2)
    assert abs(full).max() == pytest.approx(1)


CONVERGED = [
    # contact, Nr, plane; u(2, 0.5) and u(1, 0.75) in m; ΣBᵀλ in 10⁷ N/m; active rows
    ("nts 10", (-0.03723, -0.29317, 0.01777, -0.04142), (3.0963, 18.0797), 8),
    ("nts 20", (-0.03739, -0.29423, 0.01782, -0.04148), (3.0632, 18.0928), 16),
    ("nts 30", (-0.03742, -0.29446, 0.01783, -0.04151), (3.0771, 18.0904), 24),
    ("nts 40", (-0.03743, -0.29455, 0.01784, -0.04152), (3.0862, 18.0887), 31),
    ("mortar 30", (-0.03742, -0.29447, 0.01784, -0.04151), (3.0782, 18.0902), 24),
    ("mortar 40", (-0.03743, -0.29455, 0.01784, -0.04152), (3.0793, 18.0893), 31),
    ("nts 30 stress", (-0.04056, -0.31721, 0.01912, -0.04397), (3.3344, 18.0222), 26),
    ("nts 40 stress", (-0.04057, -0.31729, 0.01913, -0.04398), (3.3386, 18.0208), 35),
]  # fmt: skip
QUICK = ("nts 10", "mortar 30", "nts 30 stress")


@pytest.mark.parametrize(
    ("problem", "u", "force", "active"),
    [
        pytest.param(*row, marks=[pytest.mark.slow] * (row[0] not in QUICK))
        for row in CONVERGED
    ],
)
def test_linearised_to_convergence_it_has_the_reference_values(
    problem, u, force, active
):
    """The reference values are those of an independent prototype of the same
    discretisation."""
    contact, size, plane = (*problem.split(), "strain")[:3]
    Nr = int(size)
    keys = dict(Nr=Nr, Nh=Nr // 2, steps=1, relin=14, plane=plane, contact=contact)
    case = build("dual-bounds", **keys)
    s = reference_solution(case.qp)
    result, nodes = case.quantities(s), case.recover(s).reshape(-1, 2)
    points = model(Nr, Nr // 2, Nr, plane).mesh.points
    at = [np.hypot(*(points - p).T).argmin() for p in ((2, 0.5), (1, 0.75))]

    assert nodes[at].ravel() == pytest.approx(u, abs=6e-6)
    assert np.divide(result["contact_force"], 1e7) == pytest.approx(force, abs=6e-5)
    assert result["active"] == active


def test_the_load_steps_of_the_paper_are_of_first_order():
    """The tip deflection is compared with that of the converged linearisation.

    Halving the load step approximately halves the error. Three linearisations of a
    single load step have a smaller error than ten load steps.
    """

    def tip(**keys):
        case = build("dual-bounds", Nr=10, Nh=5, **keys)
        return case.quantities(reference_solution(case.qp))["tip"][1]

    exact = tip(steps=1, relin=14)
    errors = [abs(tip(steps=n) - exact) for n in (5, 10, 20, 40)]

    assert np.log2(np.divide(errors[:-1], errors[1:])) == pytest.approx(1, abs=0.15)
    assert abs(tip(steps=1, relin=3) - exact) < errors[1]
    assert abs(tip(steps=1, relin=2) - exact) > errors[1]


@pytest.mark.slow
@pytest.mark.parametrize("basis", ["dual", "standard"])
def test_mortar_agrees_with_node_to_segment_as_the_mesh_is_refined(basis):
    def force(contact, Nr):
        keys = dict(steps=1, relin=10, contact=contact, basis=basis)
        case = build("dual-bounds", Nr=Nr, Nh=Nr // 2, **keys)
        return case.quantities(reference_solution(case.qp))["contact_force"][0]

    apart = [abs(force("mortar", Nr) / force("nts", Nr) - 1) for Nr in (8, 16, 32)]

    assert apart[2] < apart[0]
    assert apart[2] < 2e-3


def test_smalbe_and_clarabel_agree_in_energy_on_every_case_of_the_demo():
    """Energies of primal and dual solutions, verified at tol 1e-8, agree to 1e-6."""
    suite = load_suite(suites_folder() / "demo.toml", PROBLEMS, SOLVERS)
    energies = {}
    for name in (case for case in suite.cases.cold if case.family_name == "beam-ring"):
        case = name.build(reference_solution)
        for solver in (SMALBE(), Clarabel()):
            if not solver.declines(case.qp):
                result, energy = physical(case, solver, 1e-8)
                physics = (name.params["Nr"], name.params["step"])
                energies.setdefault(physics, []).extend([result["energy"], energy])

    assert len(energies) == 6
    for values in energies.values():
        assert len(values) == 6  # three solutions, each with two energies
        assert values == pytest.approx(values[:1] * 6, rel=1e-6)


def in_space(form="dual", tol=1e-11, **keys):
    """Return the quantities of a coarse benchmark, three-dimensional if `depth` is
    positive.
    """
    keys = dict(Nr=2, Nh=2, steps=2) | keys
    configured = FAMILY.with_keys(**keys)
    case = configured.build(form, reference_solution)
    return case.quantities(SMALBE().prepare(case.qp, tol)())


@pytest.mark.parametrize("form", ["dual", "dual-bounds"])
def test_extruded_bodies_in_plane_strain_are_those_of_the_plane(form):
    plane = in_space(form)
    for depth in (1, 3):
        space = in_space(form, depth=depth, sides="plane-strain")
        assert space["energy"] == pytest.approx(plane["energy"], rel=1e-10)
        assert space["tip"] == pytest.approx([*plane["tip"], 0.0], abs=1e-10)
        assert space["contact_force"] == pytest.approx(
            [*plane["contact_force"], 0.0], rel=1e-9, abs=1.0
        )
        for rows in ("contact_rows", "active"):
            assert space[rows] == (depth + 1) * plane[rows]
        assert space["multiplier_sum"] == pytest.approx(plane["multiplier_sum"])


@pytest.mark.parametrize(
    "cells", [(2, 4), pytest.param((4, 8), marks=pytest.mark.slow)]
)
def test_face_mortar_differs_from_the_plane_by_the_square_of_h(cells):
    """Each face has a single normal, whereas normals are interpolated in
    two dimensions.
    """
    gaps = []
    for n in cells:
        keys = dict(Nr=n, Nh=n, steps=1, contact="mortar", tol=1e-10)
        plane, space = in_space(**keys), in_space(**keys, depth=1, sides="plane-strain")
        gaps.append(abs(space["energy"] / plane["energy"] - 1))
    assert gaps[0] / gaps[1] > 3


def test_free_ends_soften_the_bodies():
    assert in_space(depth=2)["energy"] < in_space()["energy"] < 0
