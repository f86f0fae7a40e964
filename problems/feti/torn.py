"""Bodies torn into subdomains: what every part of Total FETI works on.

Dostál, Horák and Kučera 2006: every subdomain floats; supports, gluing and contact are
rows of one matrix B, so that the kernel of every stiffness is known beforehand.

Torn unknowns v (N,) are numbered subdomain after subdomain, and within one node by
node, each component in the frame of its subdomain. Subdomains that differ by a rigid
motion only, as those in one layer of a ring, are of one kind then: they share one
stiffness, one factor and one explicit operator, and B holds the rotations. A
displacement u (n,) of the whole is v = T u, one d×d block per torn node.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csc_array, csr_array

from harness import Vector
from problems.fem.mesh import Nodes


@dataclass(frozen=True, eq=False, kw_only=True)
class Kind:
    """A subdomain, up to its place: what all subdomains of one kind share."""

    K: csc_array  #: (n_k, n_k) stiffness in the frame of the subdomain
    R: NDArray[np.float64]  #: (n_k, r) orthonormal basis of ker K
    fixing: Nodes  #: components of few nodes that no motion of R leaves at rest
    #: components of all nodes on the boundary of the subdomain, ascending: those that
    #: Dirichlet preconditioners condense onto, glued or free
    boundary: Nodes
    stiffness: Vector  #: (n_k,) modulus of the cells around each component, as K has it


@dataclass(frozen=True, eq=False, kw_only=True)
class Torn:
    """A contact problem on torn bodies, without dimensions.

    ::

        min ½vᵀKv − fᵀv   subject to   B_E v = c_E,  B_I v ≤ c_I,   K = diag(K_1 … K_S)

    Rows of B are those of supports and gluing (E), then of contact (normals, then
    tangents). Each is multiplied with its entry of `scale`, so that λ of the rows as
    they were is scale·λ.
    """

    kinds: tuple[Kind, ...]
    kind: NDArray[np.int64]  #: (S,) of each subdomain
    spread: csr_array  #: T (N, n)
    B: csr_array  #: (m, N), scaled
    c: Vector  #: (m,), scaled
    scale: Vector  #: (m,) positive
    f: Vector  #: (N,) Tᵀf is the load of the whole
    equalities: int  #: rows of B that are equations, the first ones

    @cached_property
    def start(self) -> NDArray[np.int64]:
        """First torn unknown of each subdomain, and N: (S + 1,)."""
        sizes = np.array([kind.R.shape[0] for kind in self.kinds])[self.kind]
        return np.concatenate([[0], np.cumsum(sizes)])
