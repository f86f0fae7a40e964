"""The packages whose versions decide how fast a solver is, and what it answers."""

from __future__ import annotations

#: of adapters, and those that do their work: backends, and factorisations
PACKAGES = (
    "clarabel", "cvxopt", "cvxpy", "daqp", "highspy", "highspy-extras", "osqp", "piqp",
    "proxsuite", "py-mkl-pardiso", "qoco", "qpalm", "qpsolvers", "qtqp", "quadprog",
    "scs", "sip-qp-python",
)  # fmt: skip
