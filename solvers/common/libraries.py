"""Packages whose versions affect the times and answers of solvers."""

from __future__ import annotations

#: packages that solvers call, their backends, and factorisation libraries
PACKAGES = (
    "clarabel", "cvxopt", "cvxpy", "daqp", "ecos", "highspy", "highspy-extras", "osqp",
    "piqp", "proxsuite", "py-mkl-pardiso", "pyamg", "qoco", "qpalm", "qpsolvers",
    "qtqp", "quadprog", "scs", "sip-qp-python",
)  # fmt: skip
