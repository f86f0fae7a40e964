"""Contact with a rigid plane, linear in the displacement."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from mortarbench.problems.contact.node_to_segment import ContactRows
from mortarbench.problems.fem.mesh import Mesh, Nodes, dofs_of, nodal_lengths


def rigid_plane_rows(
    mesh: Mesh, side: Nodes, *, tangential: bool = False
) -> ContactRows:
    """Keep the nodes of a side above the plane where the last coordinate is zero.

    In the plane that is  −u_y ≤ y, exactly; the slip is u_x.

    tangential : whether friction needs tangential rows
    """
    m, last = side.size, mesh.dim - 1
    row = np.repeat(np.arange(m if tangential else 0), last)
    slip = dofs_of(side, mesh.dim).reshape(m, -1)[:, :last].ravel()[: row.size]
    return ContactRows(
        B=csr_array(
            (np.full(m, -1.0), (np.arange(m), dofs_of(side, mesh.dim, last))),
            (m, mesh.dofs),
        ),
        c=mesh.points[side, last],
        T=csr_array(
            (np.ones(row.size), (np.arange(row.size), slip)), (row.size, mesh.dofs)
        ),
        row=row, share=nodal_lengths(mesh.points[side]), place=np.arange(m),
    )  # fmt: skip
