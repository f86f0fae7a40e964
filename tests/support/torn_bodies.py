"""Beam and ring in subdomains, for tests of what works on these."""

from typing import Any

import numpy as np

from mortarbench.problems.contact.bodies import Bodies
from mortarbench.problems.contact.linearise import linearisation
from mortarbench.problems.duality.stepping import primal_qp
from mortarbench.problems.feti.elastic import subdivide, torn
from mortarbench.problems.feti.tearing import structured_bodies
from mortarbench.problems.feti.torn import Torn
from mortarbench.problems.models.beam_ring import model


def torn_pair(rows: str = "orthonormal", most: int = 2) -> tuple[Bodies, Any, Torn]:
    """Bodies of 32 × 4 and 36 × 6 cells, their QP, and both in subdomains."""
    bodies = model(4, 3, 6, "strain")
    contact = linearisation(bodies, "mortar", "dual")(np.zeros(bodies.mesh.dofs))
    primal = primal_qp(bodies, contact)
    parts = subdivide(bodies, structured_bodies([(32, 4), (36, 6)], most))
    return bodies, primal, torn(parts, primal, rows=rows)
