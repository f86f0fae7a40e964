"""The medians behind the figures as tables for machines."""

from __future__ import annotations

import pandas as pd

from mortarbench.harness.files.experiment import Experiment
from mortarbench.reports.paper import published
from mortarbench.reports.paper.samples import medians
from mortarbench.reports.paper.timings import pinv_fit

KEYS = {
    "figure3": ("Nr", "n", "method"),
    "figure4": ("Nr", "Nh", "master", "slave", "method"),
    "figure5": ("Nr", "n", "method", "part"),
    "figure6": ("Nr", "Nh", "n", "m_E", "m_I", "method", "part"),
}


def csv_tables(experiment: Experiment) -> dict[str, pd.DataFrame]:
    """Make one table per figure, in seconds, Table 1 and the published times.

    kind: measured, or fitted where nothing was measured.
    """
    made = {"table1": pd.DataFrame(list(experiment.tables["table1"]))}
    for name, keys in KEYS.items():
        found = medians(experiment.tables[name], keys)
        rows = [
            dict(zip(keys, key, strict=True))
            | {"kind": "measured", "median": t.value, "low": t.low, "high": t.high,
               "coverage": t.coverage, "samples": t.samples}
            for key, t in found.items()
        ]  # fmt: skip
        if name == "figure5":
            rows += _fitted(experiment)
        made[name] = pd.DataFrame(rows)
    made["published"] = pd.DataFrame(
        {"part": part, "seconds": s, "machine": published.MACHINE}
        for part, s in (published.SECONDS | {"total": published.TOTAL}).items()
    )
    return made


def _fitted(experiment: Experiment) -> list[dict[str, object]]:
    rows = experiment.tables["figure5"]
    sizes = sorted({(int(r["Nr"]), int(r["n"])) for r in rows})
    made: list[dict[str, object]] = []
    for part in ("build", "multiply"):
        law = pinv_fit(rows, part)
        for Nr, n in sizes:
            if n > law.until:
                scale = float(n) ** law.power
                made.append({
                    "Nr": Nr, "n": n, "method": "pinv", "part": part, "kind": "fitted",
                    "median": law.c * scale, "low": law.low * scale,
                    "high": law.high * scale,
                })  # fmt: skip
    return made
