"""Results of contact pairs, compared with equilibrium and Hertz's solution."""

import numpy as np
import pytest

from mortarbench.harness import Solution, Status
from mortarbench.problems.contact.bodies import ContactPair
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.contact.sides import contact_sides
from mortarbench.problems.duality.monolithic import primal_qp
from mortarbench.problems.families.hertz import HertzPlane
from mortarbench.problems.families.patch import PRESSURE, ContactPatch, model
from mortarbench.problems.fem.mesh import nodal_lengths
from mortarbench.solvers.adapters.clarabel_ import Clarabel
from mortarbench.solvers.reference.solve import reference_solution
from tests.support.supported_by_contact import PRESSURE as PRESS
from tests.support.supported_by_contact import disc_between_plates

METHODS = [("nts", "dual"), ("mortar", "dual"), ("mortar", "standard")]


@pytest.mark.parametrize(("contact", "basis"), METHODS[1:])
def test_a_uniform_pressure_is_uniform_along_the_side(contact, basis):
    configured = ContactPatch().with_keys(contact=contact, basis=basis)
    case = configured.build("primal", reference_solution)
    (side,) = case.fields(Clarabel().prepare(case.qp, 1e-12)()).contacts

    assert side.name == "upper on lower"
    assert side.pressure == pytest.approx(np.full(len(side.nodes), PRESSURE), rel=1e-6)
    assert side.length.sum() == pytest.approx(1.0)
    assert np.abs(side.gap).max() <= 1e-9
    np.testing.assert_allclose(side.force[:, 1], PRESSURE * side.length, rtol=1e-6)


@pytest.mark.parametrize(("contact", "basis"), METHODS)
@pytest.mark.parametrize("disc_is_slave", [True, False])
def test_each_pair_of_a_disc_between_plates_carries_the_load(
    contact, basis, disc_is_slave
):
    case = disc_between_plates(
        8, form="dual", contact=contact, basis=basis, disc_is_slave=disc_is_slave
    )
    s = reference_solution(case.qp)
    values, sides = case.quantities(s), case.fields(s).contacts
    contacts = values["contacts"]
    on = ("disc on {}", "{} on disc")[not disc_is_slave]
    total = 3 * PRESS

    assert "contact_force" not in values  # there are two pairs
    assert list(contacts) == [on.format("lower"), on.format("upper")]
    for (name, pair), plate, sign in zip(
        contacts.items(), ("lower", "upper"), (-1, 1), strict=True
    ):
        assert pair["force"][plate] == pytest.approx(
            [0, sign * total], abs=3e-5 * total
        )
        assert pair["force"]["disc"] == pytest.approx(
            [0, -sign * total], abs=3e-5 * total
        )
        assert abs(pair["smallest_gap"]) < 1e-7
        (side,) = [side for side in sides if side.name == name]
        assert pair["largest_pressure"] == side.pressure.max()
        assert 0 < pair["half_width"] < 0.7
        apart = side.gap[np.abs(side.pressure) < 1e-3 * side.pressure.max()]
        assert np.nanmin(apart) >= -1e-9
        assert np.nanmax(side.gap) > 0.01  # the disc curves away


def test_neighbours_of_pressed_nodes_on_a_curved_side_do_not_press():
    """Rows of the dual basis exert slightly negative forces on neighbouring nodes."""
    case = disc_between_plates(8, contact="mortar", basis="dual", rollers=True)
    s = Clarabel().prepare(case.qp, 1e-10)()
    active = np.split(s.z > 1e-6 * s.z.max(), 2)
    for side, expected in zip(case.fields(s).contacts, active, strict=True):
        force = np.linalg.norm(side.force, axis=1)
        assert side.pressed(1e-6 * force.max()).tolist() == expected.tolist()
        assert (force > 1e-6 * force.max()).sum() > expected.sum()


def test_the_pressure_along_the_side_is_that_of_hertz():
    case = HertzPlane().build("primal", reference_solution)
    s = Clarabel().prepare(case.qp, 1e-10)()
    values = case.quantities(s)
    pair = values["contacts"]["cylinder on rigid"]

    assert pair["force"] == {"cylinder": pytest.approx([0, 1e7], rel=1e-6, abs=1e-2)}
    assert pair["largest_pressure"] == pytest.approx(values["p_max"], rel=1e-4)
    assert pair["half_width"] == pytest.approx(0.68078e-3, abs=0.68078e-3 / 10)


def test_a_node_without_a_row_has_no_gap_and_no_pressure():
    """The upper block is shifted by almost half its width, so that almost half of the
    slave side faces no master."""
    bodies = model(ContactPatch().with_keys(lower=8, upper=8))
    bodies.mesh.points[bodies.body_of_node == 1, 0] += 0.5 - 1e-3
    rows = linearisation(bodies, "mortar", "dual")(np.zeros(bodies.mesh.dofs))
    primal = primal_qp(bodies, rows)
    s = Solution(
        status=Status.SOLVED, x=np.zeros(bodies.mesh.dofs), y=0 * primal.b,
        z=np.ones(primal.h.size), z_box=np.zeros(bodies.mesh.dofs),
    )  # fmt: skip
    (side,) = contact_sides(bodies, primal, s, rows)
    x = bodies.mesh.points[side.nodes, 0]

    beside = x > 1.2  # the lower block ends at 1 m

    np.testing.assert_array_equal(np.isnan(side.gap[x < 0.9]), False)
    assert np.isnan(side.gap[beside]).all()
    assert not side.pressure[beside].any()
    assert side.pressure[x < 0.9].min() > 0


def test_pairs_with_a_common_slave_side_have_their_own_rows():
    """Where the two masters meet, both pairs have the same row in nodal contact."""
    bodies = model(ContactPatch().with_keys(lower=6, upper=4))
    (pair,) = bodies.pairs
    left, right = pair.master[:3], pair.master[2:]
    object.__setattr__(
        bodies, "pairs",
        (ContactPair(pair.slave, left), ContactPair(pair.slave, right)),
    )  # fmt: skip
    for contact, basis in METHODS:
        rows = linearisation(bodies, contact, basis)(np.zeros(bodies.mesh.dofs))
        second = rows.place >= pair.slave.size

        assert rows.covered == pytest.approx(
            rows.share
            / nodal_lengths(bodies.mesh.points[pair.slave])[
                rows.place % pair.slave.size
            ]
        )
        assert rows.share.sum() == pytest.approx(1.0)  # the width of the blocks
        for of_pair, master in ((~second, left), (second, right)):
            side_nodes = np.concatenate([pair.slave, master])
            part = rows.B[rows.at[of_pair]]
            assert set(part.indices // 2) <= set(side_nodes.tolist())


def test_lengths_are_those_of_the_undeformed_side():
    case = disc_between_plates(4)
    s = Clarabel().prepare(case.qp, 1e-9)()
    for side in case.fields(s).contacts:
        points = case.fields(s).points[side.nodes]
        np.testing.assert_array_equal(side.length, nodal_lengths(points))
