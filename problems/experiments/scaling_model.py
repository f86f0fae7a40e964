"""Cost model of Total FETI on large machines: time, memory and messages of a product.

A cube of structured subdomains with n = H/h cells per side is distributed over
identical cores, each with the same number of subdomains. A product with F and the
subsequent projection take

    t = local products + joints + rows + messages + reductions + coarse problem.

- *Local products.* One triangle of the block (K⁺)_bb of every subdomain is read from
  memory once; b are the components on the surface of the subdomain. If all
  subdomains of a core are congruent, they share one block, and the floating-point
  operations may determine the time.
- *Joints* of clusters: the product with V M⁺Vᵀ (see docs/feti-space.md). The columns V
  of every subdomain are applied twice, and one triangle of the dense matrix M⁺ of every
  cluster is read once.
- *Rows.* The sparse matrices B and G are read twice each.
- *Messages.* The grid of cores cuts the cube into bricks of subdomains. A row with
  entries on k cores is owned by one of them, which sends the multiplier to the other
  k − 1 cores and receives their contributions: 2(k − 1) numbers in two rounds of
  messages.
- *Reductions.* Each reduction costs one latency per level of a binary tree of cores.
- *Coarse problem.* Its unknowns are the rigid modes of every subdomain, or of every
  cluster of m × m × m subdomains. With at most `REPLICATED` unknowns, the rows of the
  explicit inverse are distributed over all cores, or each core solves with a sparse
  factor, whichever is faster. With more unknowns, one node solves with the sparse
  factor. A solve reads the factor (`factor_entries`) twice.

Clusters of side m increase the condition number by a factor of about m, and the number
of iterations by √m. Hence, the time of a solve is proportional to t·√m
(`Prediction.effective`).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, log2, prod, sqrt

BYTES = 8  #: bytes of a floating-point number
#: largest number of unknowns of a coarse problem whose inverse may be explicit
REPLICATED = 20_000
ENTRY = 12  #: bytes of an entry of a sparse matrix, including its index
#: global reductions per product with F; 4.4 to 6.8 were counted for cube-wall, n = 32
REDUCTIONS = 6.5
ENTRIES, EDGE = 31.0, 3.0  #: fitted constants of `factor_entries`


@dataclass(frozen=True, kw_only=True)
class Machine:
    """Speed of the network, and of a core while all cores of its node are busy."""

    bandwidth: float  #: memory bandwidth of a core, B/s
    rate: float  #: rate of dense matrix products, flop/s
    node_bandwidth: float  #: memory bandwidth of a node, B/s
    latency: float  #: latency of a message, and of a level of a reduction, s
    seconds_per_byte: float  #: inverse bandwidth of the network, s/B


#: machine of the extrapolation in docs/scaling-model.md, with 3 GB/s per core. The
#: bandwidth of the node reproduces the results of an earlier prototype; the values of
#: the network are typical
PAPER = Machine(
    bandwidth=3e9,
    rate=float("inf"),
    node_bandwidth=231e9,
    latency=2e-6,
    seconds_per_byte=1e-10,
)


@dataclass(frozen=True, kw_only=True)
class Distribution:
    """Distribution of a cube of subdomains over cores."""

    cores: int
    per_core: float = 8.0  #: number of subdomains per core
    cells: int = 8  #: H/h, number of cells per side of a subdomain
    #: m, number of subdomains per side of a cluster; 1 for no clusters
    cluster: float = 1.0
    #: number of components per node: 3 in elasticity, 1 in heat transfer
    components: int = 3
    congruent: bool = False  #: True if all subdomains of a core share a block

    @property
    def modes(self) -> int:
        """Number of rigid modes of a subdomain."""
        return 6 if self.components == 3 else 1

    @property
    def grid(self) -> tuple[int, int, int]:
        """Numbers of cores along the three edges of the cube, with the smallest sum."""
        grids = (
            (p, q, self.cores // p // q)
            for p in _divisors(self.cores)
            for q in _divisors(self.cores // p)
        )
        return min(grids, key=lambda each: (sum(each), each))

    @property
    def side(self) -> float:
        """Number of subdomains along an edge of the cube, not rounded to an integer."""
        side: float = (self.cores * self.per_core) ** (1 / 3)
        return side

    @property
    def cuts(self) -> tuple[int, int, int]:
        """Largest number of neighbouring bricks along each axis: 0, 1 or 2."""
        p, q, r = (min(2, cores - 1) for cores in self.grid)
        return p, q, r

    @property
    def neighbours(self) -> int:
        """Number of other cores whose bricks share a face, an edge or a corner."""
        return prod(1 + cuts for cuts in self.cuts) - 1

    @property
    def sent(self) -> float:
        """Number of values that an inner core sends in a product.

        A node with one copy in each of c subdomains on k cores has c − 1 rows per
        component, for which each of these cores sends 2(1 − 1/k)(c − 1) values on
        average. Both c and k are products of one factor per axis; for k, the factor is
        2 on the faces between bricks and 1 otherwise. Hence, the sums of 1, c, 1/k and
        c/k over the nodes of a brick are also products of one factor per axis.
        """
        n, nodes, copies, share, copied = self.cells, 1.0, 1.0, 1.0, 1.0
        for cores, cuts in zip(self.grid, self.cuts, strict=True):
            a = self.side / cores  # number of subdomains along the brick
            nodes *= a * n + 1
            copies *= a * (n + 1) + cuts
            share *= a * n + 1 - cuts / 2
            copied *= a * (n + 1)
        return 2 * self.components * (copies - copied - nodes + share)

    @property
    def entries(self) -> float:
        """Number of entries of orthonormal gluing rows B.

        A node with c copies has c(c − 1) entries per component.
        """
        S, n = self.side, self.cells
        squares = S * (n + 3) - 2  # sum of c² along an edge
        return self.components * (squares**3 - (S * (n + 1)) ** 3)

    @property
    def dofs(self) -> float:
        """Degrees of freedom of the undivided cube, counting n³ nodes per subdomain."""
        return self.components * self.cells**3 * self.cores * self.per_core

    @property
    def block(self) -> int:
        """Number of components on the surface of a subdomain, the order of (K⁺)_bb."""
        n = self.cells
        return self.components * ((n + 1) ** 3 - (n - 1) ** 3)

    @property
    def coarse(self) -> float:
        """Number of unknowns of the coarse problem."""
        return self.modes * self.cores * self.per_core / self.cluster**3


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Cost of one product with F and one projection, per core."""

    local: float  #: time of the local products, s
    joints: float  #: time of the joints of clusters, s
    rows: float  #: time of the products with B and G, s
    messages: float  #: time of the messages, s
    reductions: float  #: time of the reductions, s
    coarse: float  #: time of the coarse problem, s
    sent: float  #: data sent to all other cores, B
    blocks: float  #: memory of the blocks (K⁺)_bb of a core's subdomains, B
    factors: float  #: memory of the factors of the stiffness of these subdomains, B
    coarse_memory: float  #: memory of the coarse problem, per core or on one node, B
    steps: float  #: number of iterations relative to a run without clusters

    @property
    def seconds(self) -> float:
        """Time of one product with F and one projection, s."""
        local = self.local + self.joints + self.rows
        return local + self.messages + self.reductions + self.coarse

    @property
    def effective(self) -> float:
        """Time `seconds` multiplied by the relative number of iterations, s."""
        return self.seconds * self.steps


def factor_entries(unknowns: float, modes: int) -> float:
    """Return the number of entries of a sparse Cholesky factor of a coarse problem.

    The graph is a cube of S³ subdomains, each coupled with up to 26 others. Nested
    dissection leads to O(n^(4/3)) entries for n unknowns (George 1973, SIAM J. Numer.
    Anal. 10). The constant `ENTRIES` and the boundary correction `EDGE` were fitted to
    factors of CHOLMOD with METIS for S = 8, 12 and 16, which have 8.52e5, 5.33e6 and
    1.79e7 entries; the fit is within 2 %.
    """
    dense: float = unknowns * (unknowns + 1) / 2
    side: float = (unknowns / modes) ** (1 / 3)
    if side <= 2 * EDGE:
        return dense
    entries: float = ENTRIES * unknowns ** (4 / 3) * (1 - EDGE / side)
    return min(entries, dense)


def predict(run: Distribution, machine: Machine) -> Prediction:
    """Predict the cost of one product with F and one projection."""
    s, n = run, run.coarse
    triangle = BYTES * s.block * (s.block + 1) / 2
    distinct = 1.0 if s.congruent else s.per_core
    sent = BYTES * s.sent
    depth = ceil(log2(s.cores)) if s.cores > 1 else 0
    gather = 2 * BYTES * n * machine.seconds_per_byte * (s.cores > 1)
    solve = 2 * BYTES * factor_entries(n, s.modes)
    if n <= REPLICATED:
        coarse_memory = BYTES * n**2 / s.cores
        coarse = min(coarse_memory, solve) / machine.bandwidth + gather
    else:
        coarse_memory = solve / 2
        coarse = solve / machine.node_bandwidth + gather
    inner = s.components * (s.cells + 1) ** 3  # number of unknowns of a subdomain
    factor = BYTES * factor_entries(inner, s.components)
    return Prediction(
        local=max(
            distinct * triangle / machine.bandwidth,
            2.0 * s.block**2 * s.per_core / machine.rate,
        ),
        joints=_joints(s, machine, distinct) if s.cluster > 1 else 0.0,
        # in elasticity, each component of a node moves in 3 of the 6 rigid modes (a
        # translation, two rotations); heat transfer has a single mode. For each entry
        # of B, G therefore has 3 entries or 1 entry
        rows=2 * ENTRY * (1 + (s.modes + 1) // 2) * s.entries / s.cores
        / machine.bandwidth,
        messages=2 * s.neighbours * machine.latency + sent * machine.seconds_per_byte,
        reductions=REDUCTIONS * depth * machine.latency,
        coarse=coarse,
        sent=sent,
        blocks=distinct * triangle,
        factors=distinct * factor,
        coarse_memory=coarse_memory,
        steps=sqrt(s.cluster),
    )  # fmt: skip


def _joints(s: Distribution, machine: Machine, distinct: float) -> float:
    """Return the time of a product with V M⁺Vᵀ, s."""
    # V has `modes` columns for each of six faces and for the subdomain itself;
    # `unknowns` is the order of M⁺ of one cluster
    m, columns = s.cluster, 7 * s.modes
    unknowns = s.modes * (3 * m**2 * (m - 1) + m**3)
    inverse = BYTES * unknowns * (unknowns + 1) / 2 * s.per_core / m**3
    passes = max(
        2 * BYTES * s.block * columns * distinct / machine.bandwidth,
        4.0 * s.block * columns * s.per_core / machine.rate,
    )
    return passes + inverse / machine.bandwidth


def _divisors(n: int) -> list[int]:
    return [d for d in range(1, n + 1) if n % d == 0]
