"""Cost model of Total FETI on large machines: time, memory and messages of a product.

A cube of structured subdomains with n = H/h cells per side is distributed over
identical cores, each with the same number of subdomains. A product with F and the
subsequent projection take

    t = local products + joints + rows + messages + reductions + coarse problem.

- *Local products.* One triangle of the block (K⁺)_bb of every subdomain passes through
  memory once. Congruent subdomains share a block, and the flops decide.
- *Joints* of clusters: V M⁺Vᵀ in docs/feti-space.md. The columns V of every subdomain
  are applied twice, and a triangle of the dense M⁺ of every cluster passes once.
- *Rows.* The sparse B and G pass through memory twice each.
- *Messages.* The grid of cores cuts the body into bricks of subdomains. A row that k
  cores touch has one owner: its multiplier is sent to the others and their
  contributions are returned, 2(k − 1) numbers in two rounds of messages.
- *Reductions* cost a latency per level of a tree of cores.
- *Coarse problem.* It has the rigid modes of every subdomain, or of every cluster of
  m × m × m subdomains. Up to `REPLICATED` unknowns, the rows of its inverse are shared
  by all cores, or each core solves with a sparse factor, whichever is faster; beyond,
  one node solves with it. The factor (`factor_entries`) passes through memory twice.

Clusters of side m increase κ by a factor of about m, and the number of steps by √m. The
time of a solve is hence proportional to t·√m (`Prediction.effective`).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, log2, prod, sqrt

BYTES = 8  #: of a number
REPLICATED = 20_000  #: most unknowns of a coarse problem with an explicit inverse
ENTRY = 12  #: bytes of an entry of a sparse matrix and of its index
REDUCTIONS = 6.5  #: per application; 4.4 to 6.8 were counted on cube-wall, n = 32
ENTRIES, EDGE = 31.0, 3.0  #: of `factor_entries`


@dataclass(frozen=True, kw_only=True)
class Machine:
    """Speed of a core while all cores of its node are busy, and of the network."""

    bandwidth: float  #: memory bandwidth of a core, B/s
    rate: float  #: rate of dense matrix products, flop/s
    node_bandwidth: float  #: memory bandwidth of a node, B/s
    latency: float  #: latency of a message, and of a level of a reduction, s
    seconds_per_byte: float  #: inverse bandwidth of the network, s/B


#: machine of the extrapolation in docs/scaling-model.md, with 3 GB/s per core. The
#: bandwidth of the node reproduces an earlier prototype; the network is typical
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
    per_core: float = 8.0  #: subdomains per core
    cells: int = 8  #: H/h
    cluster: float = 1.0  #: m, subdomains per side of a cluster; 1 for no clusters
    components: int = 3  #: components per node: 3 in elasticity, 1 in heat transfer
    congruent: bool = False  #: True if all subdomains of a core share a block

    @property
    def modes(self) -> int:
        """Rigid modes of a subdomain."""
        return 6 if self.components == 3 else 1

    @property
    def grid(self) -> tuple[int, int, int]:
        """Cores along the edges of the cube, in the most cubic factorisation."""
        grids = (
            (p, q, self.cores // p // q)
            for p in _divisors(self.cores)
            for q in _divisors(self.cores // p)
        )
        return min(grids, key=lambda each: (sum(each), each))

    @property
    def side(self) -> float:
        """Subdomains along an edge of the cube."""
        side: float = (self.cores * self.per_core) ** (1 / 3)
        return side

    @property
    def cuts(self) -> tuple[int, int, int]:
        """Cuts of a brick that most cores share, along each edge: none to two."""
        p, q, r = (min(2, cores - 1) for cores in self.grid)
        return p, q, r

    @property
    def neighbours(self) -> int:
        """Other cores that share a face, an edge or a corner of a brick."""
        return prod(1 + cuts for cuts in self.cuts) - 1

    @property
    def sent(self) -> float:
        """Numbers that an inner core sends in a product.

        Each of the k cores with a node of c copies sends 2(1 − 1/k)(c − 1) numbers per
        component. Copies multiply over the edges, c = ∏cᵢ and k = ∏kᵢ, with kᵢ = 2
        where a core ends. So do the sums over the nodes of a brick, of 1, c, 1/k, c/k.
        """
        n, nodes, copies, share, copied = self.cells, 1.0, 1.0, 1.0, 1.0
        for cores, cuts in zip(self.grid, self.cuts, strict=True):
            a = self.side / cores  # subdomains along the brick
            nodes *= a * n + 1
            copies *= a * (n + 1) + cuts
            share *= a * n + 1 - cuts / 2
            copied *= a * (n + 1)
        return 2 * self.components * (copies - copied - nodes + share)

    @property
    def entries(self) -> float:
        """Entries of orthonormal gluing rows B: c(c − 1) for a node with c copies."""
        S, n = self.side, self.cells
        squares = S * (n + 3) - 2  # sum of c² along an edge
        return self.components * (squares**3 - (S * (n + 1)) ** 3)

    @property
    def dofs(self) -> float:
        """Degrees of freedom of the undivided cube, without its boundary layer."""
        return self.components * self.cells**3 * self.cores * self.per_core

    @property
    def block(self) -> int:
        """Number of components on the surface of a subdomain, which occur in rows."""
        n = self.cells
        return self.components * ((n + 1) ** 3 - (n - 1) ** 3)

    @property
    def coarse(self) -> float:
        """Unknowns of the coarse problem."""
        return self.modes * self.cores * self.per_core / self.cluster**3


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Cost of one product with F and one projection, per core."""

    local: float  #: s, as the next five
    joints: float
    rows: float
    messages: float
    reductions: float
    coarse: float
    sent: float  #: bytes to all neighbours
    blocks: float  #: memory of the blocks of its subdomains, B
    factors: float  #: of the factors of their stiffness, B
    coarse_memory: float  #: of the coarse problem, on one core or on one node, B
    steps: float  #: iterations relative to those without clusters

    @property
    def seconds(self) -> float:
        """Time of a product, s."""
        local = self.local + self.joints + self.rows
        return local + self.messages + self.reductions + self.coarse

    @property
    def effective(self) -> float:
        """Time of a product multiplied by the relative number of iterations, s."""
        return self.seconds * self.steps


def factor_entries(unknowns: float, modes: int) -> float:
    """Return the number of entries of a sparse Cholesky factor of a coarse problem.

    The graph is a cube of S³ subdomains, each coupled with 26 neighbours. Nested
    dissection leads to O(n^4/3) entries (George 1973, SIAM J. Numer. Anal. 10). The
    constant and its boundary correction were fitted to CHOLMOD with METIS for S = 8, 12
    and 16: 8.52e5, 5.33e6 and 1.79e7 entries, within 2 %.
    """
    dense: float = unknowns * (unknowns + 1) / 2
    side: float = (unknowns / modes) ** (1 / 3)
    if side <= 2 * EDGE:
        return dense
    entries: float = ENTRIES * unknowns ** (4 / 3) * (1 - EDGE / side)
    return min(entries, dense)


def predict(run: Distribution, machine: Machine) -> Prediction:
    """Predict the cost of a product with F."""
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
    inner = s.components * (s.cells + 1) ** 3  # unknowns of a subdomain
    factor = BYTES * factor_entries(inner, s.components)
    return Prediction(
        local=max(
            distinct * triangle / machine.bandwidth,
            2.0 * s.block**2 * s.per_core / machine.rate,
        ),
        joints=_joints(s, machine, distinct) if s.cluster > 1 else 0.0,
        # an entry of B is multiplied by 3 rigid modes, or by the only one
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
    """Return the time of V M⁺Vᵀ, s."""
    m, columns = s.cluster, 7 * s.modes  # of six faces and of the subdomain
    unknowns = s.modes * (3 * m**2 * (m - 1) + m**3)  # of a cluster
    inverse = BYTES * unknowns * (unknowns + 1) / 2 * s.per_core / m**3
    passes = max(
        2 * BYTES * s.block * columns * distinct / machine.bandwidth,
        4.0 * s.block * columns * s.per_core / machine.rate,
    )
    return passes + inverse / machine.bandwidth


def _divisors(n: int) -> list[int]:
    return [d for d in range(1, n + 1) if n % d == 0]
