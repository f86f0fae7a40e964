"""Synthetic result folder of a large campaign, for tests of reports.

    python tests/support/synthetic_results.py DIR [SOLVERS CASES REPEATS]

Times follow power laws with lognormal scatter, most answers are verified, and every
verdict except `declined` may occur. Equal arguments yield identical folders.
"""

import json
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from mortarbench.harness import Record, Verdict

TOL = 1e-6
CONTACTS = ("nts", "mortar")
FORMS = ("primal", "dual")
STEPS = (1, 3, 5, 8, 10)
NOT_VERIFIED = (*(v for v in Verdict if v not in (Verdict.VERIFIED, Verdict.DECLINED)),)


def records(solvers: int, cases: int, repeats: int) -> Iterator[Record]:
    """Yield solvers × cases × repeats records."""
    random = np.random.default_rng(20)
    names = [f"solver-{chr(97 + i % 26)}{i // 26 or ''}" for i in range(solvers)]
    for k in range(cases):
        form, k2 = FORMS[k % 2], k // 2
        contact, k3 = CONTACTS[k2 % 2], k2 // 2
        step, Nr = STEPS[k3 % len(STEPS)], 4 + 2 * (k3 // len(STEPS))
        for number, solver in enumerate(names):
            yield from _cell(random, solver, number, form, contact, step, Nr, repeats)


def _cell(random, solver, number, form, contact, step, Nr, repeats):
    n = 40 * Nr * Nr
    params = {"Nr": Nr, "Nh": Nr // 2, "steps": 10, "step": step, "contact": contact}
    case = f"beam-ring/Nr={Nr}/Nh={Nr // 2}/step={step}/contact={contact}/{form}"
    size = 1e-6 * (1 + number) * n ** (1 + number / 40)
    verified = random.random() < 0.93
    status = Verdict.VERIFIED if verified else random.choice(NOT_VERIFIED)
    worst = TOL * 10.0 ** (random.uniform(-3, 1) if verified else random.uniform(1, 4))
    energy = -333734.443 * Nr * (1 + 1e-9 * random.standard_normal())
    for repeat in range(repeats):
        total = size * float(np.exp(0.1 * random.standard_normal()))
        yield Record(
            run_id=f"{random.integers(1 << 48):012x}", case=case, family="beam-ring",
            params=params, form=form, solver=solver, tol=TOL, repeat=repeat,
            sizes={"variables": n, "equalities": 9 * Nr, "inequalities": 6 * Nr,
                   "bounds": 0},
            options={"max_iter": 10000, "backend": "auto"}, block=repeat,
            status=Verdict(status), claimed="solved" if verified else "failed",
            message="" if verified else f"stopped at {worst:.1e}",
            iterations=10 + number + Nr, counts={"factorisations": Nr + number},
            reported={"solve_seconds": 0.7 * total},
            dualise_seconds=2e-6 * n if form == "dual" else None,
            prepare_seconds=0.3 * total, solve_seconds=0.7 * total, total_seconds=total,
            peak_mib=160 + n / 500,
            primal=worst * random.random(), dual=worst, complementarity=worst / 2,
            gap=worst / 3, objective=-0.001668672216346 * Nr, threads=1, cpu=1,
            quantities={"nodes": n // 2, "elements": n // 2, "dofs": n,
                        "equality_rows": 9 * Nr, "contact_rows": 6 * Nr, "active": Nr,
                        "energy": energy, "tip": [0.0057, -0.053],
                        "max_von_mises": {"beam": 7.99e8, "ring": 1.27e8}},
            qp="6cd890fd85c41cd4", environment="8c2f9a56e00f",
            vectors=f"{random.integers(1 << 48):016x}",
            started=f"2026-11-{1 + repeat:02d}T06:{Nr % 60:02d}:00.000+00:00",
        )  # fmt: skip


def write(folder: Path, solvers: int = 20, cases: int = 500, repeats: int = 5) -> Path:
    """Write journal, environment and suite; return the folder."""
    journal = folder / "journal" / "synthetic.jsonl"
    journal.parent.mkdir(parents=True, exist_ok=True)
    with journal.open("w") as file:
        file.writelines(r.to_json() + "\n" for r in records(solvers, cases, repeats))
    machine = {"cpu": "a processor", "usable_cores": 2, "memory_mib": 8192}
    (folder / "environment.json").write_text(json.dumps({"machine": machine}))
    (folder / "suite.toml").write_text(f'name = "synthetic"\nrepeats = {repeats}\n')
    return folder


if __name__ == "__main__":
    write(Path(sys.argv[1]), *map(int, sys.argv[2:]))
