"""Records of solves on ranks with manufactured times.

    python -m tests.support.manufactured_ranks DIR [SCATTER]

writes a result folder with such records.
"""

import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from mortarbench.harness import Record, Verdict

WORK, ALIKE = 4e-6, 0.02  #: shared work per dof, and repeated work of each rank, s
SLOWDOWN = 1.25  #: factor by which simultaneous ranks slow each other down
PREPARED = 2e-6  #: time of preparation per dof, s; ranks share it completely


def solve_seconds(dofs: int, ranks: int) -> float:
    """Return the time of a solve on `ranks` ranks, s."""
    slow = SLOWDOWN if ranks > 1 else 1.0
    return slow * (WORK * dofs / ranks + ALIKE)


def rank_records(
    sizes: Sequence[int] = (50_000, 100_000, 200_000),
    ranks: Sequence[int] = (1, 2, 4),
    repeats: int = 3,
    scatter: float = 0.0,
) -> Iterator[Record]:
    """Yield the records of one solver on ranks, for cases of these sizes.

    scatter : standard deviation of the logarithms of times
    """
    random = np.random.default_rng(7)
    for dofs in sizes:
        for repeat in range(repeats):
            for n in ranks:
                preparation = (
                    SLOWDOWN * PREPARED * dofs / n if n > 1 else PREPARED * dofs
                )
                times = preparation, solve_seconds(dofs, n)
                label = f"smalbe ranks={n}" if n > 1 else "smalbe"
                noisy = np.array(times) * random.lognormal(0, scatter, 2)
                yield _record(dofs, n, repeat, label, noisy)


def _record(dofs, n, repeat, label, times):
    prepare, solve = map(float, times)
    return Record(
        run_id=f"{dofs:06d}{n:02d}{repeat:02d}abcd",
        case=f"membranes/S={dofs // 1000}/dual", family="membranes",
        params={"S": dofs // 1000}, form="dual", solver=label, options={}, tol=1e-6,
        repeat=repeat, block=repeat, session="one", status=Verdict.VERIFIED,
        claimed="solved", iterations=20, counts={"P_products": 24, "cg": 14},
        sizes={"variables": dofs // 50, "equalities": 10, "inequalities": 0,
               "bounds": 10},
        reported={"rank_peak_mib_mean": 90.0, "rank_peak_mib_largest": 99.0}
        if n > 1 else {},
        prepare_seconds=prepare, solve_seconds=solve, total_seconds=prepare + solve,
        peak_mib=100.0 * n, primal=1e-8, dual=1e-8, complementarity=1e-8, gap=1e-8,
        objective=-1.0, threads=1, cpu=0, ranks=n,
        quantities={"dofs": dofs, "equality_rows": 10, "contact_rows": 10,
                    "subdomains": 64},
        environment="8c2f9a56e00f",
        started=f"2026-11-22T06:{repeat:02d}:00.000+00:00",
    )  # fmt: skip


def write(folder: Path, scatter: float = 0.02) -> Path:
    """Write journal, environment and suite; return the folder."""
    journal = folder / "journal" / "ranks.jsonl"
    journal.parent.mkdir(parents=True, exist_ok=True)
    records = rank_records(ranks=(1, 2, 4, 8), repeats=5, scatter=scatter)
    journal.write_text("".join(r.to_json() + "\n" for r in records))
    machine = {"cpu": "a processor", "usable_cores": 4, "memory_mib": 8192}
    (folder / "environment.json").write_text(json.dumps({"machine": machine}))
    (folder / "suite.toml").write_text('name = "manufactured"\nrepeats = 5\n')
    return folder


if __name__ == "__main__":
    write(Path(sys.argv[1]), *map(float, sys.argv[2:]))
