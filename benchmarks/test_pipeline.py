"""Times of the stages of an analysis on the mesh of Table 1 and a coarser mesh."""

import numpy as np
import pytest

from mortarbench.problems.contact.bodies import factorise_clamped, factorise_floating
from mortarbench.problems.contact.node_to_facet import node_to_facet
from mortarbench.problems.duality.dualisation import dualise
from mortarbench.problems.families.beam_ring import BEAM, BeamRing, model
from mortarbench.problems.fem.elasticity import elasticity_matrix, stiffness
from mortarbench.solvers.reference.solve import reference_solution
from mortarbench.solvers.smalbe.solver import SMALBE

SIZES = pytest.mark.parametrize(("Nr", "Nh"), [(12, 6), (30, 15)])


def bodies_of(Nr, Nh):
    return model(Nr, Nh, 2 * Nh, "strain")


@SIZES
def test_assembly(benchmark, Nr, Nh):
    mesh = bodies_of(Nr, Nh).mesh
    D = elasticity_matrix(BEAM, "strain")

    K = benchmark(stiffness, mesh, D)

    assert K.shape == (mesh.dofs, mesh.dofs)


@SIZES
def test_linearisation(benchmark, Nr, Nh):
    bodies = bodies_of(Nr, Nh)
    u = np.zeros(bodies.mesh.dofs)

    rows = benchmark(node_to_facet, bodies.mesh.points, u, *bodies.pairs[0])

    assert len(rows.c) == 12 * Nh + 1


@SIZES
@pytest.mark.parametrize("factorise", [factorise_clamped, factorise_floating])
def test_factorisation(benchmark, factorise, Nr, Nh):
    bodies = bodies_of(Nr, Nh)

    inverse = benchmark(factorise, bodies)

    assert inverse.kernel.shape[1] == (6 if factorise is factorise_floating else 0)


@SIZES
def test_dualisation(benchmark, Nr, Nh):
    family = BeamRing()
    configured = family.with_keys(Nr=Nr, Nh=Nh, steps=1)
    primal = configured.build("primal", reference_solution).qp
    inverse = factorise_floating(bodies_of(Nr, Nh))

    dual = benchmark(dualise, primal, inverse)

    assert dual.qp.q.size == primal.b.size + primal.h.size


@SIZES
@pytest.mark.parametrize("form", ["dual", "dual-bounds"])
def test_smalbe(benchmark, form, Nr, Nh):
    family = BeamRing()
    configured = family.with_keys(Nr=Nr, Nh=Nh, steps=1)
    qp = configured.build(form, reference_solution).qp

    solution = benchmark(lambda: SMALBE().prepare(qp, 1e-8)())

    assert solution.status == "solved"
