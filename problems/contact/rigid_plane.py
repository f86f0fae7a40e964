"""Contact with a rigid plane: rows that are exactly linear in the displacement."""

from __future__ import annotations

import numpy as np
from scipy.sparse import csr_array

from mortarbench.problems.contact.node_to_segment import ContactRows
from mortarbench.problems.fem.mesh import Mesh, Nodes, dofs_of, nodal_lengths


def rigid_plane_rows(
    mesh: Mesh, side: Nodes, *, tangential: bool = False
) -> ContactRows:
    """Return rows that keep the nodes of a side where the last coordinate is ≥ 0.

    In two dimensions a row is −u_y ≤ y, without linearisation, and the slip is u_x.

    tangential : add tangential rows for friction
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
