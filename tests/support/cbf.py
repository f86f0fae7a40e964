"""Reader of the Conic Benchmark Format, version 1, from its description.

The affine expressions Ax + b of CON are in a product of cones: L= (zero), L+ (≥ 0), Q
(w₀ ≥ ‖w₁…‖) and QR (2w₀w₁ ≥ ‖w₂…‖²). The domains of the variables must be F (free).
"""

from dataclasses import dataclass

import numpy as np


@dataclass
class ConeProblem:
    cost: np.ndarray
    A: np.ndarray
    b: np.ndarray
    cones: list  #: pairs of name and size

    def violation(self, x):
        """Return the largest violation of a cone at x."""
        w, worst = self.A @ x + self.b, 0.0
        for name, size in self.cones:
            part, w = w[:size], w[size:]
            worst = max(worst, _VIOLATIONS[name](part))
        assert not w.size
        return worst

    def for_clarabel(self):
        """Return P, q, A, b and cones of Clarabel: −Ax + s = b; QR is rotated to Q."""
        import clarabel
        from scipy.sparse import csc_matrix

        kinds = {
            "L=": clarabel.ZeroConeT,
            "L+": clarabel.NonnegativeConeT,
            "Q": clarabel.SecondOrderConeT,
            "QR": clarabel.SecondOrderConeT,
        }
        A, b, start = self.A.copy(), self.b.copy(), 0
        for name, size in self.cones:
            if name == "QR":  # (w₀ + w₁)/√2 ≥ ‖((w₀ − w₁)/√2, w₂, …)‖
                two = slice(start, start + 2)
                turn = np.array([[1, 1], [1, -1]]) / np.sqrt(2)
                A[two], b[two] = turn @ A[two], turn @ b[two]
            start += size
        n = self.cost.size
        cones = [kinds[name](size) for name, size in self.cones]
        return csc_matrix((n, n)), self.cost, csc_matrix(-A), b, cones


_VIOLATIONS = {
    "L=": lambda w: np.abs(w).max(),
    "L+": lambda w: max(-w.min(), 0.0),
    "Q": lambda w: max(np.linalg.norm(w[1:]) - w[0], 0.0),
    "QR": lambda w: max(w[2:] @ w[2:] - 2 * w[0] * w[1], -w[0], -w[1], 0.0),
}


def read_cbf(path):
    """Return the problem of a CBF file."""
    lines = [line for line in path.read_text().splitlines() if line.strip()]
    sections = {}
    while lines:
        keyword = lines.pop(0)
        if keyword in ("VER", "OBJSENSE"):
            sections[keyword] = lines.pop(0)
            continue
        first = list(map(int, lines[0].split()))
        count = first[1] if keyword in ("VAR", "CON") else first[0]
        rows = [line.split() for line in lines[1 : 1 + count]]
        sections[keyword] = first, rows
        del lines[: 1 + count]
    assert (sections["VER"], sections["OBJSENSE"]) == ("1", "MIN")
    (n, _), domains = sections["VAR"]
    assert domains == [["F", str(n)]]
    (m, _), cones = sections["CON"]
    cost, A, b = np.zeros(n), np.zeros((m, n)), np.zeros(m)
    for j, value in sections["OBJACOORD"][1]:
        cost[int(j)] = float(value)
    for i, j, value in sections["ACOORD"][1]:
        A[int(i), int(j)] = float(value)
    for i, value in sections["BCOORD"][1]:
        b[int(i)] = float(value)
    return ConeProblem(cost, A, b, [(name, int(size)) for name, size in cones])
