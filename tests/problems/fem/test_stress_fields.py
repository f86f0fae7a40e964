"""Recovered stress fields: exact for constant strain."""

import numpy as np
import pytest

from mortarbench.harness import Solution, Status
from mortarbench.problems.contact.bodies import (
    assemble,
)
from mortarbench.problems.contact.node_to_facet import node_to_facet
from mortarbench.problems.contact.results import fields, nodal_stresses
from mortarbench.problems.duality.monolithic import primal_qp
from mortarbench.problems.families.beam_ring import model
from mortarbench.problems.fem.elasticity import Material, elasticity_matrix
from mortarbench.problems.fem.inverse import NO_NODES
from mortarbench.problems.fem.mesh import box

STEEL = Material(E=2e11, nu=0.3)
STRAIN = np.array([2e-3, -1e-3, 3e-3])  # ε_x, ε_y, γ_xy


def stretched(bodies):
    """Return the linear displacement u = (ε_x x + γ y, ε_y y), with constant strain."""
    x, y = bodies.mesh.points.T
    return np.column_stack([STRAIN[0] * x + STRAIN[2] * y, STRAIN[1] * y]).ravel()


@pytest.mark.parametrize("plane", ["strain", "stress"])
def test_each_body_has_the_stress_of_its_own_material_up_to_its_boundary(plane):
    """An average over both bodies would mix the moduli 200 and 20 GPa at the
    interface."""
    bodies = model(2, 2, 4, plane)
    nodal = nodal_stresses(bodies, stretched(bodies))

    for b, material in enumerate(bodies.materials):
        expected = elasticity_matrix(material, plane) @ STRAIN
        mine = bodies.body_of_node == b
        for name, value in zip(("sxx", "syy", "sxy"), expected, strict=True):
            assert nodal[name][mine] == pytest.approx(value, rel=1e-9)


def test_only_plane_strain_has_a_stress_across_the_plane():
    """In plane strain, σ_z follows from ε_z = (σ_z − ν(σ_x + σ_y))/E = 0."""
    strain, stress = (
        nodal_stresses(b, stretched(b)) for b in (model(2, 2, 4, p) for p in PLANES)
    )

    assert strain["szz"] == pytest.approx(0.3 * (strain["sxx"] + strain["syy"]))
    assert "szz" not in stress


PLANES = ("strain", "stress")


@pytest.mark.parametrize("plane", PLANES)
def test_von_mises_is_the_deviators_norm(plane):
    """σ_vM² = 3/2 s:s with the deviator s of the full stress tensor."""
    bodies = model(2, 2, 4, plane)
    u = np.random.default_rng(11).standard_normal(bodies.mesh.dofs) * 1e-3
    s = nodal_stresses(bodies, u)
    z = s.get("szz", np.zeros_like(s["sxx"]))
    mean = (s["sxx"] + s["syy"] + z) / 3
    squares = sum((part - mean) ** 2 for part in (s["sxx"], s["syy"], z))

    assert s["von_mises"] ** 2 == pytest.approx(1.5 * (squares + 2 * s["sxy"] ** 2))


def test_fields_carry_the_stresses_of_the_dimensional_displacement():
    bodies = model(2, 2, 4, "strain")
    u = stretched(bodies)
    slave, master, *_ = bodies.pairs[0]
    rows = node_to_facet(bodies.mesh.points, u, slave, master)
    primal = primal_qp(bodies, rows)
    s = Solution(
        status=Status.SOLVED, x=u / bodies.length, y=0 * primal.b, z=0 * primal.h,
        z_box=0 * u,
    )  # fmt: skip

    nodal = fields(bodies, primal, s, rows).nodal
    expected = nodal_stresses(bodies, u)
    assert list(nodal) == ["sxx", "syy", "sxy", "szz", "von_mises"]
    for name, values in nodal.items():
        assert values == pytest.approx(expected[name], rel=1e-12)


def test_all_six_stresses_of_a_body_in_space_are_exact():
    mesh, gradient = box((0, 0, 0), (1, 1, 1), (3, 3, 3)), np.arange(9) * 1e-3
    gradient = gradient.reshape(3, 3)
    bodies = assemble(
        mesh, np.zeros(27, dtype=np.int64), names=("cube",), materials=(STEEL,),
        plane=None, units=(1.0, STEEL.E), fixed=NO_NODES, load=np.zeros(mesh.dofs),
        pairs=(),
    )  # fmt: skip
    e = (gradient + gradient.T) / 2
    lame = STEEL.E * STEEL.nu / ((1 + STEEL.nu) * (1 - 2 * STEEL.nu))
    sigma = lame * np.trace(e) * np.eye(3) + STEEL.E / (1 + STEEL.nu) * e
    deviator = sigma - np.trace(sigma) / 3 * np.eye(3)

    nodal = nodal_stresses(bodies, (bodies.mesh.points @ gradient.T).ravel())

    assert nodal.keys() == {"sxx", "syy", "szz", "syz", "sxz", "sxy", "von_mises"}
    for (i, j), value in np.ndenumerate(sigma):
        if i <= j:
            name = "s" + "xyz"[i] + "xyz"[j]
            assert nodal[name] == pytest.approx(value, rel=1e-9)
    norm = np.sqrt(1.5 * (deviator**2).sum())
    assert nodal["von_mises"] == pytest.approx(norm, rel=1e-9)
