"""Sections of the report: functions of the measurements, in the order of the page."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

from mortarbench.harness.record import VERIFIED_FACTOR
from mortarbench.reports.answer import Row, decisive, rows, sentence, table
from mortarbench.reports.document import (
    Document,
    Item,
    Picture,
    Section,
    Table,
    clean,
    short_name,
)
from mortarbench.reports.figures.curves import answer_figure
from mortarbench.reports.measurements import Measurements
from mortarbench.reports.sections import context, routes, solvers

Build = Callable[[Measurements, list[Row]], Iterator[Item]]

#: Name, title and function of each section. A section without items is left out.
SECTIONS: tuple[tuple[str, str, Build], ...] = (
    ("outcomes", "Outcomes", solvers.outcomes),
    ("times", "Times per form", solvers.times),
    ("mesh", "From the mesh", routes.mesh),
    ("scaling", "Scaling", solvers.scaling),
    ("iterations", "Iterations and products", solvers.iterations),
    ("accuracy", "Accuracy", solvers.accuracy),
    ("sequences", "Sequences", routes.sequences),
    ("ranks", "Ranks", routes.ranks),
    ("physics", "Fields and physics", context.physics),
    ("validation", "Cross-validation", context.crossval),
    ("settings", "Settings and environment", context.settings),
    ("definitions", "Definitions", context.definitions),
)


def compose(run: Measurements) -> Document:
    """Compose the report: the answer first, then the sections with content.

    The measurements of several environments are not compared; each environment has its
    own answer and sections, under its name.
    """
    digests = list(dict.fromkeys(run.df.environment))
    parts = [run.only(environment=d) for d in digests]
    sections: list[Section] = []
    for k, part in enumerate(parts):
        where = f" ({machine(part, digests[k])})" if len(parts) > 1 else ""
        ending = f"-{k + 1}" if k else ""
        found = list(rows(part))
        sections.append(_answer(part, found, f"answer{ending}", f"Answer{where}"))
        for name, title, build in SECTIONS:
            if k and name in ("definitions", "validation"):
                continue
            items = tuple(
                item.compact() if isinstance(item, Table) else item
                for item in build(part, found)
            )
            if items:
                sections.append(
                    Section(name=name + ending, title=title + where, items=items)
                )
    started = run.df.started[run.df.started != ""]
    when = clean(str(started.min())[:10]) if len(started) else "date unknown"
    recomputed = f"verdicts recomputed: residuals ≤ {run.factor:g} × tol"
    facts = [when, *dict.fromkeys(machine(run, d) for d in digests)]
    facts += [recomputed] * (run.factor != VERIFIED_FACTOR)
    return Document(
        title=clean(run.name),
        dateline=" · ".join(facts),
        sections=tuple(sections),
        solvers=tuple(map(short_name, run.solvers)),
    )


def _answer(run: Measurements, found: list[Row], name: str, title: str) -> Section:
    chosen = decisive(found)
    items: list[Item] = [table(found, run.solvers), *map(sentence, chosen)]
    if any(len(row.ranked) > 1 for row in chosen):
        items.append(
            Picture(
                name=name,
                caption="Time relative to the fastest solver, with the 95 % interval "
                "of the table.",
                draw=partial(answer_figure, chosen, run.solvers),
            )
        )
    return Section(name=name, title=title, items=tuple(items))


def machine(run: Measurements, digest: str) -> str:
    """Describe the machine of an environment in a few words."""
    facts = run.environments.get(digest, {}).get("machine")
    facts = facts if isinstance(facts, dict) else {}
    parts = [str(facts.get("cpu") or "machine unknown")]
    if facts.get("usable_cores"):
        parts.append(f"{facts['usable_cores']} cores")
    return clean(", ".join(parts), 120)
