"""Selection of the public set: ``python -m mortarbench.dataset.selection``.

Every candidate is built, scaled and rounded; candidates whose optimum is not proven to
1e-8 are left out. The core are at most four problems of each family. They are chosen by
farthest points (Gonzalez 1985) in standardised features, most of them logarithms: the
next problem is the one whose nearest chosen problem is the farthest away.

The command writes the catalogue and, in ``bits.npz``, the last bits of arrays that
depend on BLAS. Items that still differ between kernels of OpenBLAS are left out.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import eigsh

from mortarbench.case import as_case
from mortarbench.dataset.folder import write_problem
from mortarbench.dataset.items import (
    BITS,
    HERE,
    INFEASIBLE,
    ITERATION,
    OPTIMAL,
    REVERSED,
    UNBOUNDED,
    Certificate,
    Row,
    cached_case,
    certificate,
    iterations,
    objections,
    original,
    scaled_qp,
    standard_qp,
    write_catalogue,
)
from mortarbench.dataset.optimum import (
    UnprovenError,
    least_curvature,
    of_unit_diagonal,
    optimum_interval,
)
from mortarbench.dataset.standard import (
    Scales,
    last_bits,
    scales_of,
)
from mortarbench.harness import QP, InputError
from mortarbench.harness.errors import say
from mortarbench.harness.files.store import write_arrays
from mortarbench.harness.suite.suite import load_suite
from mortarbench.registries import Registries, one_thread, reference

CANDIDATES = "candidates.toml"  #: suite of the single problems and most sequences
#: Bodies that only contact holds. Reversed loads pull them away.
REVERSED_CASES = (
    "membranes/n=4/primal",
    "membranes/n=8/primal",
    "membranes/n=4/dual",
    "membranes/n=8/dual",
    "contact-patch/dual",
    "hertz-plane/n=8/dual",
    "half-plane/n=40/dual",
)
#: Cases whose fixed-point iterations for Coulomb's law are sequences.
COULOMB_CASES = (
    "beam-ring/Nr=8/Nh=5/steps=1/friction=coulomb/mu=0.3/dual-bounds",
    "greco/n=16/mu=1/dual-bounds",
    "greco/n=16/mu=0.4/dual",
    "hertz-cylinder/n=10/m=8/friction=coulomb/mu=0.3/Q=0.5/dual",
)
CAP = 4  #: largest number of problems of a family in the core
#: Kernels of OpenBLAS. The last needs a processor with AVX-512.
KERNELS = ("Haswell", "Prescott", "Sandybridge", "SkylakeX")
YES = {True: "yes", False: "no"}
#: Eigenvalues of the scaled P below this fraction of the largest count as zero.
ZERO = 1e-8
#: Largest n for which all eigenvalues are computed, and their number for larger n.
MAX_DENSE, LEAST = 1500, 20
#: Constraints are active if their slack is below this fraction of the largest size;
#: active constraints are weakly active if their multiplier is, of the largest.
ACTIVE = 1e-7


def main() -> None:
    """Select the set, and write its catalogue and stored bits."""
    if sys.argv[1:]:  # in a process with a given kernel
        rows = json.load(sys.stdin)
        return print(json.dumps(_digests(rows) if rows else _candidates()))
    rows = _under(KERNELS[0], [])
    digests = [_under(kernel, rows) for kernel in KERNELS]
    rows = [row for row in rows if len({d[row["name"]] for d in digests}) == 1]
    rows = without_gaps(rows)
    choose_core(rows)
    for row in rows:
        row["digest"] = digests[0][row["name"]]
    write_catalogue(HERE, rows)
    return None


def _under(kernel: str, rows: Sequence[Row]) -> Any:
    """Return the digests of the files of items, built with a kernel of OpenBLAS.

    A digest depends on the kernel if errors exceed what the stored bits correct.
    Without rows, return those of the candidates, which do not depend on the machine.
    """
    done = subprocess.run(
        [sys.executable, "-m", "mortarbench.dataset.selection", "child"],
        input=json.dumps(rows),
        env=os.environ | {"OPENBLAS_CORETYPE": kernel},
        stdout=subprocess.PIPE,
        check=True,
        text=True,
    )
    return json.loads(done.stdout)


def _digests(rows: Sequence[Row]) -> dict[str, str]:
    with TemporaryDirectory() as folder:
        path = Path(folder, "item.npz")
        return {row["name"]: write_problem(row, path) for row in rows}


def _candidates() -> list[Row]:
    """Return the lines of all candidates with a proof, and write their bits."""
    rows, bits = [], {}
    for row in _items():
        try:
            with one_thread():
                rows.append(described(row))
                bits[row["name"]] = last_bits(scaled_qp(row))
        except (InputError, ArithmeticError) as e:
            say(f"{row['name']} is left out: {e}")
    write_arrays(HERE / BITS, bits)
    return sorted(rows, key=lambda row: row["path"])


def without_gaps(rows: Sequence[Row]) -> list[Row]:
    """Leave out sequences without a step before the last, or with less than three."""
    steps: dict[str, set[int]] = {}
    for row in rows:
        steps.setdefault(row["sequence"], set()).add(int(row["step"] or 0))
    whole = {k for k, v in steps.items() if len(v) > 2 and v == {*range(1, 1 + len(v))}}
    return [row for row in rows if row["sequence"] in {"", *whole}]


def _items() -> Iterator[Row]:
    """Yield lines with names, cases and changes of all candidates.

    The last step of a sequence, which determines its scales, precedes the others.
    """
    registries = Registries()
    suite = load_suite(HERE / CANDIDATES, registries.families, registries.solvers)
    for case in suite.cases.cold:
        yield _row(case.name, "", OPTIMAL)
    for name in REVERSED_CASES:
        kind = UNBOUNDED if name.endswith("primal") else INFEASIBLE
        yield _row(name, REVERSED, kind)
    for steps in suite.cases.sequences:
        first, last = (case.name.split("/") for case in (steps[0], steps[-1]))
        sequence = _slug(p if p in last else p.partition("=")[0] for p in first)
        key = next(p.partition("=")[0] for p in first if p not in last)
        values = [case.params[key] for case in steps]
        sequence += "-jumps" * (values != sorted(values))
        for step, case in reversed([*enumerate(steps, 1)]):
            yield _row(case.name, "", OPTIMAL, sequence, step)
    for name in COULOMB_CASES:
        sequence = _slug([*name.split("/"), "iterations"])
        for step in reversed(range(1, 1 + len(iterations(name)))):
            yield _row(name, f"{ITERATION}{step}", OPTIMAL, sequence, step)


def _row(case: str, change: str, kind: str, sequence: str = "", step: int = 0) -> Row:
    case = as_case(case).name
    name = _slug(case.split("/")) + "-reversed" * (change == REVERSED)
    name = f"{sequence}/{step:03}" if sequence else name
    return {
        "name": name,
        "path": f"{'sequences' if sequence else 'problems'}/{name}.npz",
        "core": "no",
        "family": case.partition("/")[0],
        "sequence": sequence,
        "step": str(step or ""),
        "kind": kind,
        "case": case,
        "change": change,
        "licence": "BSD-3-Clause",
        "units": "none; energy in SI = energy_scale * f + energy_constant",
        "provenance": f"mortarbench export {case} FILE.npz"
        + f", {change}" * bool(change),
    }


def _slug(parts: Iterable[str]) -> str:
    return re.sub(r"\.0\b|=", "", "-".join(parts))


_SCALES: dict[str, Scales] = {}  #: scales of a sequence: those of its last step


def described(row: Row) -> Row:
    """Return the line of a candidate with all columns but its digest.

    Raises
    ------
    InputError, ArithmeticError
        If the case cannot be built, or its optimum is not proven.

    """
    case = cached_case(row["case"]).family_case
    qp, value = original(row["case"], row["change"]), 0.0
    if row["kind"] == OPTIMAL:
        value = qp.objective(reference(qp).x)
    scales = scales_of(qp, value)
    if row["sequence"]:
        scales = _SCALES.setdefault(row["sequence"], scales)
    row |= {"scales": " ".join(map(str, scales)), "shifted": "no"}
    if row["kind"] != UNBOUNDED and not least_curvature(standard_qp(row).P):
        row["shifted"] = "yes"
    final = standard_qp(row)
    proof = certificate(row["kind"], final)
    row |= {"optimum": "", "bound": ""}
    if row["kind"] == OPTIMAL:
        row |= _optimum(final, proof)
    for objection in objections(row, final, proof):
        raise UnprovenError(objection)
    factor = 2.0 ** -scales[1] * case.scale
    constant = "" if row["change"] else f"{case.constant:.12g}"
    row |= {"energy_scale": f"{factor:.12g}", "energy_constant": constant}
    return row | _structure(final) | _activity(final, proof)


def _optimum(qp: QP, proof: Certificate) -> Row:
    """Return the optimum, and a bound of its error.

    The bound is at least twice the error, because other certificates, computed with
    another kernel of BLAS, prove the optimum to a slightly different accuracy.
    """
    low, high = optimum_interval(qp, proof["x"], proof["y"], proof["z"])
    optimum = float(f"{(low + high) / 2:.12g}")
    size = max(1.0, abs(optimum))
    error = 2 * max(high - optimum, optimum - low) + 1e-12 * size
    bound = max(10 ** np.ceil(np.log10(error / size)), 1e-9) * size
    return {"optimum": repr(optimum), "bound": repr(float(bound))}


def _structure(qp: QP) -> Row:
    """Return sizes, and estimates of condition and rank of the scaled P."""
    n, sizes, M = qp.q.size, qp.sizes, of_unit_diagonal(qp.P)
    if M.shape[0] <= MAX_DENSE:
        values = np.linalg.eigvalsh(M.toarray())
    else:
        start = np.ones(M.shape[0])  # the default of eigsh is random
        least = eigsh(M, LEAST, sigma=-1e-6, v0=start, return_eigenvectors=False)
        values = np.append(least, eigsh(M, 1, v0=start, return_eigenvectors=False))
    positive = values[values > ZERO * values.max()]
    rank = M.shape[0] - (values.size - positive.size)
    entries = csc_array(qp.P).nnz + csc_array(qp.A).nnz + csc_array(qp.G).nnz
    return {
        "dense": YES[isinstance(qp.P, np.ndarray)],
        "strictly_convex": YES[rank == n],
        "discs": str(sizes.get("discs", 0)),
        "n": str(n),
        **{name: str(sizes[name]) for name in ("equalities", "inequalities", "bounds")},
        "nnz": str(entries),
        "condition": f"{positive.max() / positive.min():.1e}",
        "rank": str(rank),
    }


def _activity(qp: QP, proof: Certificate) -> Row:
    """Return the share of active inequalities, and of weakly active ones among them."""
    if not {"x", "y", "z"} <= proof.keys():
        return {"active_share": "", "degeneracy": ""}
    x, z = proof["x"], proof["z"]
    force = np.abs(qp.P @ x + qp.q + qp.A.T @ proof["y"] + qp.G.T @ z)
    limits = [limit for one in qp.sets for limit in one.limits(x)]
    slack = np.concatenate([qp.h - qp.G @ x, *(limit.slack for limit in limits)])
    multiplier = np.concatenate([z, *(force[limit.variable] for limit in limits)])
    active = slack <= ACTIVE * max(np.abs(x).max(), 1e-300)
    weak = active & (multiplier <= ACTIVE * max(multiplier.max(initial=0.0), 1e-300))
    return {
        "active_share": f"{active.mean() if active.size else 0:.3f}",
        "degeneracy": f"{weak.sum() / max(active.sum(), 1):.3f}",
    }


def features(row: Row) -> list[float]:
    """Return the features by which problems are compared."""
    n, m, p, nnz, condition, rank, active, weak = (
        float(row[name] or 0)
        for name in ("n", "equalities", "inequalities", "nnz", "condition", "rank",
                     "active_share", "degeneracy")
    )  # fmt: skip
    sizes = np.log10([n, 1 + m + p, nnz / n, condition])
    classes = row["discs"] != "0", row["dense"] == "yes", row["kind"] != OPTIMAL
    return [*sizes, active, weak, 1 - rank / n, *map(float, classes)]


def choose_core(rows: Sequence[Row]) -> None:
    """Set ``core`` of the `CAP` most different single problems per family to ``yes``.

    The first is the one nearest to the mean of all. Ties go to the earlier line.
    """
    single = [row for row in rows if not row["sequence"]]
    points = np.array([features(row) for row in single])
    points = (points - points.mean(axis=0)) / np.maximum(points.std(axis=0), 1e-12)
    for family in {row["family"] for row in single}:
        members = [i for i, row in enumerate(single) if row["family"] == family]
        far = 1 / (1 + np.linalg.norm(points[members], axis=1))
        for number in range(min(CAP, len(members))):
            i = members[int(np.argmax(far))]
            single[i]["core"] = "yes"
            distance = np.linalg.norm(points[members] - points[i], axis=1)
            far = np.minimum(far, distance) if number else distance


if __name__ == "__main__":
    main()
