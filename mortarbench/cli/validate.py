"""The command `validate`: do the answers that a result folder holds agree."""

from __future__ import annotations

import json
from argparse import Namespace
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

from harness.crossval.comparison import brief
from harness.crossval.discretisation import Discretisation, discretisation_errors
from harness.crossval.summary import as_data
from harness.crossval.validation import validated
from harness.errors import InputError, say
from harness.files.durable import full_disk_told, replace_file
from harness.names import assemble
from harness.results.journal import read_journal
from mortarbench.cli.registries import Registries
from mortarbench.cli.text import aligned, legible

_MOST = 12  #: entries of a list on the terminal; the page has them all


def validate(registries: Registries, options: Namespace) -> int:
    """Cross-validate a result folder; 1 if a claim is refuted or answers disagree."""
    if not options.budget >= 0:  # a NaN, too
        raise InputError(
            f"--budget {options.budget:g}; expected a number of seconds ≥ 0"
        )
    registries = registries.with_files(options.plugin)
    found = validated(options.folder, registries.families, registries.reference, say)
    data = as_data(found, options.folder.resolve().name)
    if not (data["counts"]["answers"] or found.false_claims):
        why = found.not_validated[0].text if found.not_validated else "none is a claim"
        raise InputError(f"{options.folder}: no stored answer can be judged: {why}")
    target = options.folder / "validation.json"
    text = json.dumps(data, allow_nan=False) + "\n"
    with full_disk_told(options.folder):
        replace_file(target, text.encode())
    pages = registries.validation(options.folder, data, ())
    if meshes := _meshes(registries, options.folder, options.budget):
        # the page was there while meshes were solved; now it tells of them, too
        pages = registries.validation(options.folder, data, meshes)
    if options.json:
        verdict = {k: v for k, v in data.items() if k != "problems"}
        verdict["discretisation"] = [asdict(d) for d in meshes]
        print(json.dumps(verdict, allow_nan=False))
    else:
        print(as_text(data))
        if known := [d for d in meshes if d.error is not None]:
            lines = [f"{d.case}: {_mesh(d)}" for d in known]
            title = (
                "Discretisation errors, relative, in the energy norm; `report` shows "
                "what they are worth"
            )
            print(f"\n{_list(title, lines)}")
        for page in pages:
            print(page)
    return 0 if found.agreed else 1


def _meshes(
    registries: Registries, folder: Path, budget: float
) -> list[Discretisation]:
    """Solve the folder's cases on finer meshes, where families say what these are."""
    families = registries.families
    records = {r.case: r for r in read_journal(folder, say) if r.family in families}
    cases = []
    for r in records.values():
        with suppress(InputError):  # of another version: listed as not validated
            case = assemble(families[r.family], r.params, r.form)
            if case.family.refined(case.params) is not None:
                cases.append(case)
    return discretisation_errors(cases, registries.reference, folder, budget, say)


def _mesh(d: Discretisation) -> str:
    before = "less than " if d.kind == "rounding" else ""
    return f"{before}{_e(d.error)}{' to the next mesh' * (d.kind == 'change')}"


def as_text(data: Mapping[str, Any]) -> str:
    """Lay out one screen: the verdict, a row per solver, what is wrong."""
    parts = [legible(data["headline"]), _solvers(data["solvers"])]
    entries = {
        "Refuted claims": _refuted(data["disagreements"]),
        "Apart without a culprit": [
            f"{d['problem']}, tol {d['tol']:g}: {' and '.join(d['between'])} are "
            f"{_e(d['distance'])} apart, allowed {_e(d['allowed'])}"
            for d in data["unresolved"]
        ],
        "Certificates contradicted (a fault of ours)": list(
            map(_listed, data["contradictions"])
        ),
        "Not validated": _together(data["not_validated"]),
        "Without a reference": [
            f"{d['problem']}: {d['text']}" for d in data["without_reference"]
        ],
    }
    parts += [_list(title, lines) for title, lines in entries.items() if lines]
    small = [
        f"{data['counts'][key]} {words}"
        for key, words in (
            ("remarks", "stand out from the other solvers, within what they claim"),
            ("unanswered", "measurements ended without an answer"),
        )
        if data["counts"][key]
    ]
    return "\n\n".join([*parts, *(["; ".join(small) + "."] if small else [])])


def _solvers(rows: Sequence[Mapping[str, Any]]) -> str:
    """Lay out a row per solver."""
    columns = {
        "error_median": "error: median", "error_worst": "worst",
        "penetration": "penetration/h", "balance": "balance",
        "primal_dual": "primal-dual", "from_ours": "from smalbe",
    }  # fmt: skip
    if all(row["from_ours"] is None for row in rows):
        del columns["from_ours"]  # there is no smalbe to compare with
    head = ["solver", "tol", "answers", "refuted", "unanswered", *columns.values()]
    lines = [
        [
            legible(row["solver"]),
            f"{row['tol']:g}",
            *(str(row[key]) for key in ("answers", "refuted", "unanswered")),
            *(_e(row[key]) for key in columns),
        ]
        for row in rows
    ]
    table = aligned([head, *lines], right=range(1, len(head)))
    return f"Certified errors: relative, in the energy norm.\n{table}"


def _refuted(wrong: Sequence[Mapping[str, Any]]) -> list[str]:
    """List every claim, or, of very many, the worst of each solver."""
    if len(wrong) <= _MOST:
        return list(map(_wrong, wrong))
    own: dict[str, list[Mapping[str, Any]]] = {}
    for d in wrong:
        own.setdefault(d["solver"], []).append(d)
    return [
        f"{_wrong(max(claims, key=lambda d: d['error'] or 0.0))}"
        + (f" (the worst of {len(claims)})" if len(claims) > 1 else "")
        for claims in own.values()
    ]


def _wrong(d: Mapping[str, Any]) -> str:
    error = f"; error {_e(d['error'])}" if d["error"] is not None else ""
    return f"{d['solver']} on {d['case']}, tol {d['tol']:g}: {_reasons(d)}{error}"


def _reasons(d: Mapping[str, Any]) -> str:
    return "; ".join(d["reasons"])


def _listed(d: Mapping[str, Any]) -> str:
    return f"{d['solver']} on {d['case']}, tol {d['tol']:g}: {d['text']}"


def _together(listed: Sequence[Mapping[str, Any]]) -> list[str]:
    """Say once what concerns all answers to a case."""
    counted: dict[tuple[str, str], int] = {}
    for d in listed:
        key = (d["case"], d["text"])
        counted[key] = counted.get(key, 0) + 1
    return [
        f"{case} ({n} answer{'s' * (n != 1)}): {text}"
        for (case, text), n in counted.items()
    ]


def _list(title: str, lines: Sequence[str]) -> str:
    shown = [f"  {legible(line)}" for line in lines[:_MOST]]
    more = len(lines) - _MOST
    if more > 0:
        shown.append(f"  … and {more} more, see the page")
    return "\n".join([f"{title}:", *shown])


def _e(value: float | None) -> str:
    if value is None:
        return "-"
    return brief(value) if value else "0"
