"""Cost model of Total FETI on large machines: time, memory and messages of a product.

A cube of structured subdomains with n = H/h cells per side is distributed over
identical cores, each with the same number of subdomains. A product with F and the
subsequent projection take

    t = max(bytes/bandwidth, flops/rate) + messages + reductions + coarse problem.

- *Local products.* One triangle of the block (K⁺)_bb of every subdomain is read from
  memory once. Congruent subdomains share a block; the flops then determine the time.
- *Coarse problem.* Its unknowns are the rigid modes of every subdomain, or of every
  cluster of m × m × m subdomains. Up to `REPLICATED` unknowns, the rows of its inverse
  are distributed over all cores. For more unknowns, one node solves with a sparse
  factor of L entries (`factor_entries`), which is read from memory twice.
- *Messages* with the values on the surface of a core go to its neighbours. A reduction
  costs one latency per level of a tree of cores.

Clusters of side m increase κ by a factor of about m, and the number of steps by √m. The
time of a solve is hence proportional to t·√m (`Prediction.effective`).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, log2, sqrt

BYTES = 8  #: size of a number
REPLICATED = 20_000  #: largest coarse problem with an explicit inverse, unknowns
#: reductions per application: 420 to 430 in 65 or 66 applications on cube-wall, n = 32
REDUCTIONS = 6.5
ENTRIES, EDGE = 31.0, 3.0  #: fitted constants of `factor_entries`


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

    local: float  #: time of local products, s
    messages: float  #: time of messages, s
    reductions: float  #: time of reductions, s
    coarse: float  #: time of the coarse problem, s
    sent: float  #: data sent to all neighbours, B
    blocks: float  #: memory of the blocks of the subdomains, B
    factors: float  #: memory of the factors of their stiffness matrices, B
    coarse_memory: float  #: memory of the coarse problem, on a core or a node, B
    steps: float  #: number of iterations relative to that without clusters

    @property
    def seconds(self) -> float:
        """Time of a product, s."""
        return self.local + self.messages + self.reductions + self.coarse

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
    side: float = (unknowns / modes) ** (1 / 3)
    entries: float = ENTRIES * unknowns ** (4 / 3) * (1 - EDGE / side)
    return entries


def predict(run: Distribution, machine: Machine) -> Prediction:
    """Predict the cost of a product with F."""
    s, n = run, run.coarse
    triangle = BYTES * s.block * (s.block + 1) / 2
    distinct = 1.0 if s.congruent else s.per_core
    flops = 2.0 * s.block**2 * s.per_core
    side = s.cells * s.per_core ** (1 / 3) + 1  # nodes along the edge of a core's cube
    shared = min(6, s.cores - 1) / 6  # share of its surface adjacent to other cores
    sent = shared * BYTES * s.components * (side**3 - (side - 2) ** 3)
    neighbours = min(26, s.cores - 1)
    depth = ceil(log2(s.cores)) if s.cores > 1 else 0
    gather = 2 * BYTES * n * machine.seconds_per_byte * (s.cores > 1)
    if n <= REPLICATED:
        coarse_memory = BYTES * n**2 / s.cores
        coarse = coarse_memory / machine.bandwidth + gather
    else:
        coarse_memory = BYTES * factor_entries(n, s.modes)
        coarse = 2 * coarse_memory / machine.node_bandwidth + gather
    inner = s.components * (s.cells + 1) ** 3  # unknowns of a subdomain
    factor = BYTES * factor_entries(inner, s.components)
    return Prediction(
        local=max(distinct * triangle / machine.bandwidth, flops / machine.rate),
        messages=neighbours * machine.latency + sent * machine.seconds_per_byte,
        reductions=REDUCTIONS * depth * machine.latency,
        coarse=coarse,
        sent=sent,
        blocks=distinct * triangle,
        factors=distinct * factor,
        coarse_memory=coarse_memory,
        steps=sqrt(s.cluster),
    )
