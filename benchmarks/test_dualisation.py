"""Times to dualise ten load steps, by condensation and by solves for each step.

Dualisation computes the matrix F and the vector d of the dual QP.
"""

import numpy as np
import pytest

from mortarbench.problems.contact.bodies import factorise_floating
from mortarbench.problems.duality.dualisation import dualise
from mortarbench.problems.families.beam_ring import BeamRing, model
from mortarbench.solvers.reference.solve import reference_solution


@pytest.fixture(scope="module")
def steps():
    family = BeamRing()
    params = [family.with_keys(Nr=30, Nh=15, step=k) for k in range(1, 11)]
    return [p.build("primal", reference_solution).qp for p in params]


def test_dualisation_of_ten_steps(race, steps):
    bodies = model(30, 15, 30, "strain")
    factor, condensed = (
        factorise_floating(bodies, condense=False),
        factorise_floating(bodies),
    )

    def all_steps(inverse):
        return [dualise(primal, inverse).qp for primal in steps]

    race(
        condensed_with_setup=lambda: all_steps(factorise_floating(bodies)),
        condensed_without_setup=lambda: all_steps(condensed),
        blocked_solves_factor_given=lambda: all_steps(factor),
        rounds=5,
    )

    for a, b in zip(all_steps(condensed), all_steps(factor), strict=True):
        assert abs(a.P - b.P).max() <= 1e-9 * abs(b.P).max()
        assert abs(a.q - b.q).max() <= 1e-9 * np.abs(b.q).max()
