"""Cost model of Total FETI beyond this machine: time, memory and messages of a product.

A cube of structured subdomains with n = H/h cells per side is shared by equal cores,
each with the same number of subdomains. A product with F, and the projection that
belongs to it, take

    t = max(bytes/bandwidth, flops/rate) + messages + reductions + coarse problem.

- *Local products.* One triangle of the block (K⁺)_bb of every subdomain passes through
  memory once. Congruent subdomains share a block, and the flops decide.
- *Coarse problem.* It has the rigid modes of every subdomain, or of every cluster of
  m × m × m subdomains. Up to `REPLICATED` unknowns, the rows of its inverse are shared
  by all cores; beyond, one node solves with a sparse factor of L entries
  (`factor_entries`), which passes through its memory twice.
- *Messages* go to the neighbours of a core, with the values on its surface; reductions
  cost a latency per level of a tree of cores.

Clusters of side m raise κ about m-fold and the steps √m-fold, so that the time of a
solve is proportional to t·√m (`Prediction.effective`).
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, log2, sqrt

BYTES = 8  #: of a number
REPLICATED = 20_000  #: most unknowns of a coarse problem with an explicit inverse
REDUCTIONS = 6.5  #: per application; 420 to 430 in 65 or 66 on cube-wall, n = 32
ENTRIES, EDGE = 31.0, 3.0  #: of `factor_entries`


@dataclass(frozen=True, kw_only=True)
class Machine:
    """Speeds of a core while all cores of its node work, and of the network."""

    bandwidth: float  #: of memory, B/s
    rate: float  #: of products of dense matrices, flop/s
    node_bandwidth: float  #: of the memory of a node, B/s
    latency: float  #: of a message, and of a level of a reduction, s
    seconds_per_byte: float  #: of messages


#: Machine of the extrapolation in docs/scaling-model.md: 3 GB/s per core. The bandwidth
#: of its node reproduces an earlier prototype; the network is a usual one.
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
    per_core: float = 8.0  #: subdomains of a core
    cells: int = 8  #: H/h
    cluster: float = 1.0  #: m, subdomains along the side of a cluster; 1: none
    components: int = 3  #: per node: 3 in elasticity, 1 in heat transfer
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
        """Components of a subdomain that occur in rows: those of its surface."""
        n = self.cells
        return self.components * ((n + 1) ** 3 - (n - 1) ** 3)

    @property
    def coarse(self) -> float:
        """Unknowns of the coarse problem."""
        return self.modes * self.cores * self.per_core / self.cluster**3


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """Cost of one product with F and one projection, on each core."""

    local: float  #: s, as the next three
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
        return self.local + self.messages + self.reductions + self.coarse

    @property
    def effective(self) -> float:
        """Time of a product multiplied by the growth of the iterations, s."""
        return self.seconds * self.steps


def factor_entries(unknowns: float, modes: int) -> float:
    """Return the entries of a sparse Cholesky factor of a coarse problem.

    The graph is a cube of S³ subdomains that are coupled with 26 neighbours each.
    Nested dissection leaves O(n^4/3) entries (George 1973, SIAM J. Numer. Anal. 10).
    The constant and its correction for the boundary fit CHOLMOD with METIS on S = 8, 12
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
    shared = min(6, s.cores - 1) / 6  # part of that surface with other cores
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
