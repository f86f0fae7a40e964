"""Sizes and repetitions of the experiments, for the paper and for quick runs."""

from __future__ import annotations

from dataclasses import dataclass

from mortarbench.problems.experiments.clock import Rounds


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Parameters of all experiments, most of which the paper does not state."""

    assembly: tuple[int, ...]  #: values of Nr in Figure 3
    assembly_rounds: Rounds
    #: values of Nr and of Nh in Figure 4
    contact: tuple[tuple[int, ...], tuple[int, ...]]
    contact_rounds: Rounds
    inverse: tuple[int, ...]  #: values of Nr in Figure 5
    inverse_rounds: Rounds
    dense: int  #: largest number of dofs for which a dense pseudoinverse is computed
    #: values of Nr in Figure 6, ascending; Table 1 uses the last
    scaling: tuple[int, ...]
    scaling_rounds: Rounds
    Nh: int = 15  #: value of Nh in Figures 6, 7 and Table 1
    example: tuple[int, int] = (4, 3)  #: values of Nr and Nh in Figure 2
    steps: int = 10  #: number of load steps


PAPER = Plan(
    assembly=(2, 4, 6, 10, 15, 20, 25, 30, 40, 50, 60, 80, 100),
    assembly_rounds=Rounds(most=100, least=10, seconds=15),
    contact=((5, 10, 20, 30, 60, 120), (5, 10, 15, 30, 60, 120)),
    contact_rounds=Rounds(most=40),
    inverse=(2, 3, 4, 5, 6, 7, 8, 9, 10, 12, 15, 20, 25, 30, 40, 60),
    inverse_rounds=Rounds(most=10, least=6, seconds=30),
    dense=2000,
    scaling=(2, 5, 10, 15, 20, 25, 30),
    scaling_rounds=Rounds(most=10, least=6, seconds=60),
)  # fmt: skip

QUICK = Plan(
    assembly=(3, 6, 10, 15, 20, 30, 40),
    assembly_rounds=Rounds(most=30, least=6, seconds=1),
    contact=((10, 20, 30, 60), (5, 10, 15, 30)),
    contact_rounds=Rounds(most=15, least=6, seconds=0.3),
    inverse=(2, 3, 4, 5, 6, 8, 10, 15, 20, 30),
    inverse_rounds=Rounds(most=6, least=6, seconds=1),
    dense=800,
    scaling=(5, 15, 30),
    scaling_rounds=Rounds(most=6, least=2, seconds=2),
)  # fmt: skip
