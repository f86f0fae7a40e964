"""Scaling of the variables of a QP by √diag P, and its inverse.

With D = diag(P) and y = D¹ᐟ²x, the QP in y has the matrix D⁻¹ᐟ²PD⁻¹ᐟ² with unit
diagonal. This is Jacobi scaling. If the rows of P have at most k nonzero entries, the
condition number is at most k times the smallest that a diagonal scaling can reach (van
der Sluis, Numer. Math. 14, 1969, 14-23). Bounds of x become bounds of y. On a disc, D
is the mean of diag(P) over the variables of the disc, so that a disc of x becomes a
disc of y. The stopping test uses KKT residuals of the original QP.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csc_array, diags_array

from mortarbench.harness import QP, Box, Discs, Matrix, Solution, Vector
from mortarbench.solvers.smalbe.compiled import IncompleteFactor, scaled_by_diagonal
from mortarbench.solvers.smalbe.preconditioner import MAX_UNSCALED
from mortarbench.solvers.smalbe.projected import Spectrum

#: over discs, smaller entries of D are replaced by this factor times the largest one
SMALLEST_DIAGONAL = 1e-10
#: a negative sum Σⱼ Pᵢⱼwⱼ counts as zero if its absolute value is at most this factor
#: times Pᵢᵢwᵢ
ROUNDING = 1e-12


@dataclass(frozen=True, eq=False)
class Scaled:
    """A QP in scaled variables, with the recovery of x."""

    original: QP
    qp: QP  #: QP in y = D¹ᐟ²x; `original` if D is nearly constant
    #: (n,) D¹ᐟ², over discs rounded to powers of two; ones if D is nearly constant
    root: Vector

    @classmethod
    def over_discs(cls, qp: QP) -> Scaled:
        """Scale a QP over discs with a dense P, by powers of two.

        Powers of two cause no rounding errors, so that a point of a disc of y is a
        point of the disc of x.
        """
        D = np.asarray(qp.P.diagonal()).copy()
        discs = [one for one in qp.sets if isinstance(one, Discs)]
        for one in discs:
            D[one.index] = D[one.index].mean(axis=1, keepdims=True)
        # along redundant rows, D is zero or a rounding error
        D = np.maximum(D, SMALLEST_DIAGONAL * D.max(initial=0.0))
        if D.max() <= MAX_UNSCALED * D.min():
            return cls(qp, qp, np.ones(D.size))
        root = np.exp2(np.round(np.log2(D) / 2))
        inverse = 1 / root
        scaled = QP(
            P=inverse[:, None] * np.asarray(qp.P) * inverse,
            q=qp.q * inverse,
            A=qp.A @ diags_array(inverse),
            b=qp.b,
            G=qp.G,
            h=qp.h,
            sets=(
                Box(qp.lb * root, qp.ub * root),
                *(replace(d, radius=d.radius * root[d.index[:, 0]]) for d in discs),
            ),
        )
        return cls(qp, scaled, root)

    def recovered(self, s: Solution) -> Solution:
        """Return the point of the original QP; components at bounds stay at bounds."""
        if self.qp is self.original:
            return s
        x = np.clip(s.x / self.root, self.original.lb, self.original.ub)
        x = np.where(s.x <= self.qp.lb, self.original.lb, x)
        x = np.where(s.x >= self.qp.ub, self.original.ub, x)
        return replace(s, x=x, z_box=s.z_box * self.root)


@dataclass(frozen=True, eq=False)
class ScaledSparse(Scaled):
    """A sparse QP in scaled variables, with data to compute a factor."""

    P: Matrix  #: P of `original`
    diagonal: Vector  #: (n,) diagonal of P
    #: upper bound on the norm of the matrix H of `qp`, from the largest sum Σⱼ|Sᵢⱼ| of
    #: S = D⁻¹ᐟ²PD⁻¹ᐟ²
    norm: float
    weights: Vector  #: (n,) w > 0; Pw ≥ 0 up to rounding if `has_weights`
    has_weights: bool
    with_factor: bool  #: True to use an incomplete factor as preconditioner

    @classmethod
    def of(cls, qp: QP, *, with_factor: bool) -> ScaledSparse:
        """Scale a QP with bounds only and a sparse P with a positive diagonal."""
        P = qp.P
        diagonal = P.diagonal()
        root, scaled, one = np.sqrt(diagonal), qp, np.ones(diagonal.size)
        inverse = 1 / root
        data, norm, least, least_scaled = scaled_by_diagonal(P, inverse)
        if (most := diagonal.max()) > MAX_UNSCALED * diagonal.min():
            P_scaled = csc_array((data, P.indices, P.indptr), shape=P.shape)
            scaled = QP(
                P=P_scaled,
                q=qp.q * inverse,
                A=qp.A,
                b=qp.b,
                G=qp.G,
                h=qp.h,
                lb=qp.lb * root,
                ub=qp.ub * root,
            )
        else:  # ‖P‖ ≤ ‖H‖ max D
            root, norm = one, float(norm * most)
        weights, has_weights = one, True
        if least < -ROUNDING:
            weights, has_weights = inverse, least_scaled >= -ROUNDING
        return cls(
            qp, scaled, root, P, diagonal, norm, weights, has_weights, with_factor
        )

    def spectrum(self) -> Spectrum:
        """Return the bound on the norm by Gershgorin's theorem, without Ritz pairs."""
        return Spectrum(self.norm, None)

    def factor(self) -> IncompleteFactor:
        """Return the incomplete factor of H/norm, where H is the matrix of `qp`."""
        scale = np.sqrt(self.norm) * self.root * self.weights
        return IncompleteFactor(self.P, self.weights, scale, self.has_weights)
