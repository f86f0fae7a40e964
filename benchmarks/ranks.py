"""Wall time, peak memory and products of a solve on one process and on two ranks.

    python benchmarks/ranks.py [--case CASE] [--repeats N] [CHECKOUT …]

Each repeat runs ``python -m mortarbench solve CASE --solver smalbe --tol 1e-6 --mpi N
--json``, from the mesh to the verdict, on N = 1 and 2, in this checkout and in each
other CHECKOUT in turn, with the .venv of that checkout. The script prints medians, and
the median of the ratios of wall times within a repeat to those of one process of this
checkout. Memory is `peak_mib` of the record: the solver's process, or all ranks with
the processes that start them. It asserts no results, because machines differ.
"""

import argparse
import json
import subprocess
import time
from pathlib import Path
from statistics import median

CASE = "beam-ring/Nr=112/Nh=64/steps=1/feti=16/dual"


def solve(checkout: Path, case: str, ranks: int) -> dict[str, float | str]:
    """Return the costs of one solve by a command in a checkout."""
    start = time.perf_counter()
    done = subprocess.run(
        [
            checkout / ".venv" / "bin" / "python", "-m", "mortarbench", "solve", case,
            "--solver", "smalbe", "--tol", "1e-6", "--mpi", str(ranks), "--json",
        ],
        cwd=checkout, capture_output=True, text=True,
    )  # fmt: skip
    seconds = time.perf_counter() - start
    if not done.stdout:
        raise SystemExit(f"{checkout}: {done.stderr}")
    record = json.loads(done.stdout)
    return {
        "wall": seconds,
        "solve": (record["prepare_seconds"] or 0) + (record["solve_seconds"] or 0),
        "MiB": record["peak_mib"],
        "products": record["counts"].get("P_products"),
        "status": record["status"],
    }


def main() -> None:
    """Measure in interleaved repeats, and print one line for each command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--case", default=CASE)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("checkouts", nargs="*", type=Path, metavar="CHECKOUT")
    options = parser.parse_args()
    for checkout in options.checkouts:
        if not (checkout / ".venv" / "bin" / "python").exists():
            parser.error(f"{checkout}: no .venv/bin/python; expected a checkout")
    here = Path(__file__).resolve().parent.parent
    ways = [(c, n) for c in (here, *options.checkouts) for n in (1, 2)]
    found = {way: [] for way in ways}
    for _ in range(options.repeats):
        for checkout, ranks in ways:
            costs = solve(checkout.resolve(), options.case, ranks)
            found[checkout, ranks].append(costs)
    print(f"{options.case}, {options.repeats} repeats")
    for (checkout, ranks), costs in found.items():
        ratios = (
            a["wall"] / b["wall"] for a, b in zip(costs, found[ways[0]], strict=True)
        )
        medians = {k: median(c[k] for c in costs) for k in ("wall", "solve", "MiB")}
        print(
            f"{checkout.resolve().name:12} {ranks} ranks: wall {medians['wall']:.2f} s "
            f"({median(ratios):.2f}), prepare + solve {medians['solve']:.3f} s, "
            f"{medians['MiB']:.0f} MiB, {costs[0]['products']} products, "
            f"{', '.join(sorted({c['status'] for c in costs}))}"
        )


if __name__ == "__main__":
    main()
