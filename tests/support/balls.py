"""A convex set that mortarbench does not provide: balls on blocks of variables."""

from dataclasses import dataclass

import numpy as np

from mortarbench.harness.sets.convex import Limits


@dataclass(frozen=True, eq=False)
class Balls:
    """The set ‖x[index[i]]‖ ≤ radius[i] for disjoint blocks of equal size."""

    index: np.ndarray  #: (k, d)
    radius: np.ndarray  #: (k,)

    @property
    def block(self):
        return np.sort(self.index.ravel())

    def check(self, n):
        if self.radius.min() < 0 or self.index.max() >= n:
            raise ValueError("QP.sets: a radius is negative, or an index too large")

    def hull(self, n):
        size = np.full(n, np.inf)
        size[self.index] = self.radius[:, None]
        return -size, size

    def _norms(self, x):
        return np.linalg.norm(x[self.index], axis=1)

    def project(self, x):
        x, norms = x.copy(), self._norms(x)
        outside = norms > self.radius
        factor = self.radius[outside] / norms[outside]
        x[self.index[outside]] *= factor[:, None]
        return x

    def limits(self, x):
        norms = self._norms(x)
        first = self.index[:, 0]
        return [Limits("ball", self.radius - norms, self.radius, norms, first)]

    def admissible(self, z):
        borne = np.zeros_like(z)
        borne[self.index] = z[self.index]
        return borne

    def support(self, z):
        return float(self.radius @ self._norms(z))

    def support_gaps(self, x, z, limits):
        return [self.radius * self._norms(z) - (z * x)[self.index].sum(axis=1)]

    def substituted(self, T, a):
        """Return the balls in the variables y of x = T y + a.

        All entries of T have the same absolute value, and a is zero on the blocks.
        """
        assert not a[self.index].any()
        entries = T.tocoo()
        assert len({*np.abs(entries.data)}) == 1
        column = np.zeros(T.shape[0], dtype=int)
        column[entries.row] = entries.col
        return Balls(column[self.index], self.radius / abs(entries.data[0]))

    def arrays(self):
        return {"ball_index": self.index, "ball_radius": self.radius}
