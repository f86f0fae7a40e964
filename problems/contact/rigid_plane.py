"""Contact with the rigid plane y = 0, linear in the displacement."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from mortarbench.problems.contact.node_to_segment import ContactRows
from mortarbench.problems.fem.mesh import Mesh, Nodes, nodal_lengths


def above_plane(mesh: Mesh, side: Nodes, *, tangential: bool = False) -> ContactRows:
    """Keep the nodes of a side above the plane:  −u_y ≤ y, exactly; slip is u_x.

    tangential : whether friction needs tangential rows
    """
    m = side.size
    held = np.arange(m) if tangential else np.arange(0)
    return ContactRows(
        B=csr_array((np.full(m, -1.0), (np.arange(m), 2 * side + 1)), (m, mesh.dofs)),
        c=mesh.points[side, 1],
        T=csr_array(
            (np.ones(held.size), (np.arange(held.size), 2 * side[held])),
            (held.size, mesh.dofs),
        ),
        row=held, share=nodal_lengths(mesh.points[side]), place=np.arange(m),
    )  # fmt: skip
