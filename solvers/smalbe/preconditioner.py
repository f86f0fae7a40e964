"""Preconditioners of the CG steps on a face of the box.

The preconditioner `model` is inverted on each face (model.pxi), `incomplete` is
factorised on each face (incomplete.pxi), and `sparse` approximates the inverse on each
face (approximate.pxi). All other preconditioners use the same matrix M for all faces,
restricted to the free components of the face: z = Mφ with the free gradient φ. For a
dual with F = BK⁺Bᵀ, the structural preconditioners are

    lumped      M = B_D K_bb B_Dᵀ
    dirichlet   M = B_D S_bb B_Dᵀ,   S_bb = K_bb − K_bi K_ii⁻¹ K_ib

where the index b denotes the displacements that occur in B, and i all other
displacements. B_D = (BWBᵀ)⁻¹BW has the weights W = diag(K_bb)⁻¹, so that
the softer of two bodies takes the larger part of a jump (Rixen and Farhat 1999). An
operator P may provide its own preconditioners (`harness.operators.Preconditioned`).

Inside SMALBE, H = 𝒫F𝒫/‖𝒫F𝒫‖ + ρQ is approximated by the model of the penalty, B = I +
(ρ − 1)Q. On the free components, here denoted by the index F, the inverse P = B_FF⁻¹ is
nearly the projector onto C_Fν = 0. M replaces the identity on the range of this
projector:

    P (‖𝒫F𝒫‖ M_FF − I) P + P

This matrix is positive definite (0 < P ≤ I). It is accurate even if C_F C_Fᵀ has small
eigenvalues, which occur for motions that contact constraints resist but gluing
constraints hardly resist. With the projector 𝒫 of all components instead of P, free and
active components would be mixed and the effect of a large ρ would be lost.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, NamedTuple, get_args

import numpy as np
from scipy.sparse import csc_matrix, diags_array, issparse

from mortarbench.harness import QP, Structure
from mortarbench.harness.operators import Preconditioned, preconditioned
from mortarbench.solvers.smalbe.compiled import (
    ApproximateInverse,
    IncompleteFactor,
    Product,
    sparsity,
)
from mortarbench.solvers.smalbe.extension import Operator
from mortarbench.solvers.smalbe.rows import Mask

Preconditioner = Literal[
    "auto", "model", "sparse", "incomplete", "diagonal", "lumped", "dirichlet", "none"
]
PRECONDITIONERS = get_args(Preconditioner)
#: preconditioners with a matrix or operator M
STRUCTURAL = ("sparse", "diagonal", "lumped", "dirichlet")
#: entries that a CG step with an incomplete factor reads, in units of the entries of P:
#: one product, and two substitutions with a triangle each
STEP = 2
#: Smallest levels·spread^¼ (see `Sparsity`) for which a factor is used. The value was
#: chosen on thirty string, obstacle, journal bearing and torsion problems of 20 to
#: 20 000 unknowns. Below this value, a solve with a factor takes up to 2.8 times as
#: long as with `model` and saves at most 0.2 ms. Above this value, a solve with a
#: factor takes at most a quarter longer (a flat obstacle, n = 110) and saves up to
#: 97 %.
MIN_DIFFICULTY = 50.0
#: a negative row sum Σⱼ Pᵢⱼ counts as zero if it is at least this factor times −Pᵢᵢ
ROUNDING = 1e-12
#: relative increase of diag(BWBᵀ), because B may contain repeated rows
DEPENDENT = 1e-10


def preconditioned_operator(qp: QP) -> Preconditioned | None:
    """Return P as an operator that provides preconditioners, or None."""
    if isinstance(qp.P, np.ndarray) or issparse(qp.P):
        return None
    return preconditioned(qp.P)


class Sparsity(NamedTuple):
    """Properties of a sparse P that determine the choice of a preconditioner."""

    #: number of pairs of entries below the diagonal in the same column, which is the
    #: number of steps of an incomplete factorisation; inf if a diagonal entry is not a
    #: finite positive number
    pairs: float
    #: n divided by twice the mean distance of the off-diagonal entries from the
    #: diagonal, as an estimate of the number of levels of the graph of P; n/2 for a
    #: string, about √n for a grid in its natural order, less than 2 for a random order,
    #: and 0 for a diagonal P
    levels: float
    spread: float  #: ratio of the largest to the smallest diagonal entry
    norm: float  #: largest sum Σⱼ|Pᵢⱼ| of a row, an upper bound on ‖P‖ (Gershgorin)
    least: float  #: smallest sum Σⱼ Pᵢⱼ of a row, relative to Pᵢᵢ


def resolved_preconditioner(
    qp: QP, kind: Preconditioner, P: Sparsity | None = None
) -> Preconditioner:
    """Replace ``auto`` by the preconditioner that is fastest for `qp`.

    A CG step with an incomplete factor costs four to seven times as much as a step
    without a factor. The factor therefore saves time if CG without a factor takes more
    than about 150 steps. This number of steps grows with `Sparsity.levels` and with the
    fourth root of `Sparsity.spread`. The choice of ``auto`` is dirichlet if P is an
    operator that provides it, otherwise incomplete if it saves time, otherwise diagonal
    if the diagonal of a sparse P varies, otherwise model.

    P : the result of `sparsity_of` for `qp`, if it is known
    """
    if kind != "auto":
        return kind
    if isinstance(qp.P, np.ndarray):
        return "sparse"
    if preconditioned_operator(qp):
        return "dirichlet"
    P = P or sparsity_of(qp)
    if P is None:
        return "model"
    pays = P.levels * P.spread**0.25 >= MIN_DIFFICULTY
    if pays and P.pairs <= STEP * qp.P.nnz:
        return "incomplete"
    # On 20 Laplacians in mixed units with spreads of 1.5, 3 and 9, the diagonal takes
    # 0.86, 0.73 and 0.45 times as many products as the model. With a zero on the
    # diagonal, P may have no inverse and the QP no minimum.
    varies = 1 < P.spread < np.inf and P.pairs < np.inf
    return "diagonal" if varies else "model"


def incomplete_factor(qp: QP, P: Sparsity) -> tuple[float, IncompleteFactor]:
    """Return a bound on ‖P‖ and the incomplete factor of P divided by this bound.

    Dropped entries are added to the diagonal only if no row sum of P is negative, apart
    from rounding: P then maps the vector of ones to zero in the interior of a domain.
    """
    return P.norm, IncompleteFactor(qp.P, P.norm, P.least >= -ROUNDING)


def has_sparse_factor(qp: QP) -> bool:
    """Return True if an incomplete factor of the free block of P is cheap.

    A factor requires a sparse P with a positive diagonal. The QP must have bounds only,
    because a factor of P does not include the penalty of rows. The factorisation must
    not cost more than a CG step.
    """
    P = sparsity_of(qp)
    return P is not None and P.pairs <= STEP * qp.P.nnz


def sparsity_of(qp: QP) -> Sparsity | None:
    """Return the properties of a sparse P of a QP with bounds only, otherwise None."""
    P = qp.P
    if not issparse(P) or qp.b.size or qp.h.size or not qp.q.size:
        return None
    if len(qp.sets) > 1 or P.nnz >= 2**31:
        return None
    return Sparsity(*sparsity(P if P.format in ("csr", "csc") else csc_matrix(P)))


def missing_data(qp: QP, kind: Preconditioner) -> str | None:
    """Return the reason why `kind` is unavailable for `qp`, or None."""
    if kind == "incomplete" and not has_sparse_factor(qp):
        return (
            "preconditioner 'incomplete' needs a sparse P with a positive diagonal and "
            "few entries per row, and bounds only"
        )
    if kind == "sparse" and not isinstance(qp.P, np.ndarray):
        return "preconditioner 'sparse' needs a dense P"
    if kind == "diagonal" and qp.diagonal() is None:
        return "preconditioner 'diagonal' needs a P with a known diagonal"
    if (
        kind in ("lumped", "dirichlet")
        and qp.structure is None
        and not preconditioned_operator(qp)
    ):
        return f"preconditioner {kind!r} needs a QP with structure; 'diagonal' does not"
    return None


def structural_preconditioner(
    qp: QP, kind: Preconditioner, F: Product
) -> Operator | ApproximateInverse | None:
    """Return M for `kind` in `STRUCTURAL`, otherwise None.

    F : the product with P
    """
    if kind == "sparse":
        return ApproximateInverse(F)
    if kind not in STRUCTURAL:
        return None
    diagonal = qp.diagonal()
    if kind == "diagonal" and diagonal is not None:
        inverse = 1 / np.where(diagonal > 0, diagonal, 1.0)
        return lambda v: inverse * v
    if (operator := preconditioned_operator(qp)) is not None:
        return operator.preconditioner(kind, "stiffness")
    if qp.structure is None:
        raise ValueError(missing_data(qp, kind))
    return _of_stiffness(qp.structure, _lumped if kind == "lumped" else _schur)


def _of_stiffness(
    structure: Structure, of_interface: Callable[[csc_matrix, Mask], Operator]
) -> Operator:
    """Return v ↦ B_D S B_Dᵀ v, where S is K_bb or S_bb from `of_interface`."""
    from sksparse.cholmod import (
        cholesky,
    )  # imported here because other preconditioners do not need CHOLMOD

    acting = np.ones(structure.K.shape[0], dtype=bool)
    acting[structure.fixed] = False
    K = csc_matrix(structure.K)[acting][:, acting]
    B = csc_matrix(csc_matrix(structure.B)[:, acting])
    touched = np.diff(B.indptr) > 0
    stiffness = of_interface(K, touched)
    B = B[:, touched]
    BW = B @ diags_array(1 / K.diagonal()[touched])
    jump = csc_matrix(BW @ B.T)
    jump += csc_matrix(diags_array(DEPENDENT * jump.diagonal()))
    solve = cholesky(jump)
    return lambda v: solve(BW @ stiffness(BW.T @ solve(v)))


def _lumped(K: csc_matrix, touched: Mask) -> Operator:
    K_bb = K[touched][:, touched]
    return lambda u: K_bb @ u


def _schur(K: csc_matrix, touched: Mask) -> Operator:
    """Return the product with the Schur complement S_bb; takes one solve with K_ii."""
    from sksparse.cholmod import cholesky

    K_bb, K_ib = K[touched][:, touched], csc_matrix(K[~touched][:, touched])
    solve = cholesky(csc_matrix(K[~touched][:, ~touched]))
    return lambda u: K_bb @ u - K_ib.T @ solve(K_ib @ u)
