"""The contact rows of a set of bodies by the method that the keys of a case name."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from scipy.sparse import csr_array, vstack

from harness import InputError, Vector
from problems.contact.bodies import Bodies
from problems.contact.mortar import mortar
from problems.contact.node_to_segment import ContactRows, node_to_segment


def linearisation(
    bodies: Bodies, contact: str, basis: Any
) -> Callable[[Vector], ContactRows]:
    """Return the map from a displacement (n,) in m to the rows of all pairs.

    It raises InputError where at u = 0 there is no row at all.
    """
    rows = node_to_segment if contact == "nts" else partial(mortar, basis=basis)

    def linearise(u: Vector) -> ContactRows:
        parts = [rows(bodies.mesh.points, u, *pair) for pair in bodies.pairs]
        B = csr_array(vstack([part.B for part in parts]))
        if not B.shape[0] and not u.any():
            raise InputError(
                "no node of a slave side faces its master within reach; expected two "
                "sides that face each other, each with its body on the left"
            )
        return ContactRows(B, np.concatenate([part.c for part in parts]))

    return linearise
