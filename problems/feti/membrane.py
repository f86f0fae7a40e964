"""Strings and membranes on uniform grids, torn into subdomains."""

from __future__ import annotations

import numpy as np

from problems.fem.fixing import fixing_nodes
from problems.fem.laplacian import grid_stiffness
from problems.feti.tearing import Part
from problems.feti.torn import Kind


def membrane_kind(part: Part, h: float = 1.0) -> Kind:
    """Assemble one floating block of a grid, under unit tension.

    Its kernel are the constants. Its nodes are numbered as those of `grid_stiffness`.

    h : length of a cell
    """
    places = [np.unique(x.round(9)) for x in (part.points / h).T]
    cells = tuple(x.size - 1 for x in places)
    nodes = len(part.points)
    at = np.indices([x.size for x in places]).reshape(len(cells), -1)
    last = np.array(cells)[:, None]
    return Kind(
        K=grid_stiffness(cells, h),
        R=np.full((nodes, 1), nodes**-0.5),
        fixing=fixing_nodes(part.points),
        boundary=np.flatnonzero(((at == 0) | (at == last)).any(axis=0)),
        stiffness=np.ones(nodes),
    )
