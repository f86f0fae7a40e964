"""The page: every figure and table of the paper, what it says and what we find."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

from mortarbench.harness.files.experiment import Experiment, Row
from mortarbench.reports.data.evidence import Evidence
from mortarbench.reports.document.formatting import clean, seconds, significant
from mortarbench.reports.document.layout import Page, Picture, Section
from mortarbench.reports.figures.deformed import PERCENTILE, SCALE
from mortarbench.reports.paper import beyond, published
from mortarbench.reports.paper.geometry import geometry_figure, mesh_figure
from mortarbench.reports.paper.samples import curve
from mortarbench.reports.paper.stress import STRESSES, extent, stress_figure
from mortarbench.reports.paper.tables import here, largest, of_table_1, table_1, timings
from mortarbench.reports.paper.timings import (
    assembly_figure,
    contact_figure,
    inverse_figure,
    pinv_fit,
    scaling_figure,
)


def compose(
    experiment: Experiment, suites: Mapping[str, Evidence] = MappingProxyType({})
) -> Page:
    """Put the page together: the paper in its order, then what it does not have.

    suites : measured ones by name; those of `BEYOND` make sections
    """
    machine = experiment.setting["environment"].get("machine", {})
    now = experiment.setting["environment"].get("now", {}).get("time", "")
    sections = (
        _summary(experiment),
        _geometry(experiment),
        _mesh(experiment),
        _assembly(experiment),
        _contact(experiment),
        _inverse(experiment),
        _scaling(experiment),
        _final(experiment),
        *beyond.physics(experiment),
        *(s for name, of in BEYOND.items() if name in suites for s in of(suites[name])),
        Section(name="errata", title="Errata of the paper", points=published.ERRATA),
    )
    return Page(
        title="The paper's figures and tables",
        dateline=clean(
            f"{published.PAPER}. Measured {now} on {here(machine)}; published times: "
            f"{published.MACHINE}.",
            400,
        ),
        sections=sections,
        footer="Every sample is in data/, the medians in tables/*.csv; the figures are "
        "drawn from these files alone.",
    )


#: suite → sections on it
BEYOND = {"paper-fleet": beyond.fleet, "paper-accuracy": beyond.certified}


def _summary(experiment: Experiment) -> Section:
    rows = largest(experiment)
    Nr, Nh, n = (rows[0][k] for k in ("Nr", "Nh", "n"))
    ours, theirs = (
        curve(rows, "n", method=m)[0].time for m in ("condensed", "per-row")
    )
    prose = (
        f"The whole analysis at Nr = {Nr}, Nh = {Nh} (n = {n}) takes {seconds(ours)} "
        "here with the dual condensed onto the interface and our SMALBE, "
        f"{seconds(theirs)} the paper's way: one solve per constraint row and load "
        "step, the textbook's SMALBE; both in one interleaved run."
    )
    if of_table_1(rows):
        ratio = significant(published.TOTAL / ours.value)
        prose += (
            f" Published: {published.TOTAL:.2f} s ({published.MACHINE}), {ratio} times "
            "as long. Of this ratio the machine and the language are a part that "
            "cannot be told from here; compare methods within one machine."
        )
    return Section(
        name="summary",
        title="Summary",
        prose=(
            prose,
            "Times are medians of interleaved repeats in one process, with the "
            "distribution-free 95 % interval of the median in brackets and as bars "
            "(below six repeats: smallest and largest, which cover less). Garbage "
            "collection is off. Methods are ours throughout, also those marked “the "
            "paper's way”: its own code is not public.",
        ),
    )


def _geometry(experiment: Experiment) -> Section:
    E = {k: m["E"] / 1e9 for k, m in experiment.setting["materials"].items()}
    nu = experiment.setting["materials"]["beam"]["nu"]
    caption = (
        "Geometry, supports and load, drawn from the mesh. Hatched: clamped. "
        f"E = {E['beam']:g} GPa (A) and {E['ring']:g} GPa (B), ν = {nu:g} in both."
    )
    figure = geometry_figure(
        experiment.states["example-2Nh"], experiment.setting["load"]
    )
    return _section("figure1", "Geometry", figure, caption)


def _mesh(experiment: Experiment) -> Section:
    Nr, Nh = experiment.setting["plan"]["example"]
    examples = {
        f"{what} layers: {_nodes(experiment, name)} nodes": experiment.states[name]
        for name, what in (("example-Nh", "$N_h$"), ("example-2Nh", "$2N_h$"))
    }
    caption = (
        f"Mesh with Nr = {Nr}, Nh = {Nh} and its deformation (displacement × "
        f"{SCALE:g}) with two numbers of radial layers. (a), (b): the picture in the "
        f"paper, Nh layers, {_nodes(experiment, 'example-Nh')} nodes (the paper: "
        f"{published.FIGURE_2_NODES}). (c), (d): the rule of its text and Table 1, "
        f"2·Nh layers, {_nodes(experiment, 'example-2Nh')} nodes."
    )
    return _section("figure2", "Mesh and solution", mesh_figure(examples), caption)


def _nodes(experiment: Experiment, state: str) -> int:
    return len(experiment.states[state].points)


def _assembly(experiment: Experiment) -> Section:
    rows = experiment.tables["figure3"]
    caption = (
        "Assembly of the rectangle's stiffness matrix against its size, "
        f"{_repeats(rows)} repeats (the paper: averages of 100 runs of the vectorised "
        "library [6]). Star: its one printed number, 0.087 s, which is for both bodies "
        f"({published.DOFS} dofs)."
    )
    return _section("figure3", "Assembly", assembly_figure(rows), caption)


def _contact(experiment: Experiment) -> Section:
    rows = experiment.tables["figure4"]
    caption = (
        "One linearisation of the contact at u = 0 against the slave segments (ring), "
        "a line for each number of master segments (beam), "
        f"{_repeats(rows)} repeats (the paper: averages of 10 runs). Star: a tenth of "
        "its 2.064 s for ten steps with 240 master and 180 slave segments "
        f"({published.MACHINE})."
    )
    return _section("figure4", "Contact rows", contact_figure(rows), caption)


def _inverse(experiment: Experiment) -> Section:
    rows = experiment.tables["figure5"]
    law = pinv_fit(rows, "build")
    caption = (
        "Generalised inverse of the rectangle's stiffness: building it (a), "
        f"multiplying it with a random vector (b), {_repeats(rows)} repeats (the "
        "paper: averages of 10 runs). The dense pseudoinverse is measured up to "
        f"n = {law.until:g}; the dotted continuation is not: it is c·n³ (a) and c·n² "
        f"(b), fitted to the sizes from {law.since:g} on, its band the spread of c "
        "over them. The two inverses are different matrices (see the errata)."
    )
    return _section("figure5", "Generalised inverse", inverse_figure(rows), caption)


def _scaling(experiment: Experiment) -> Section:
    rows = experiment.tables["figure6"]
    steps = experiment.setting["plan"]["steps"]
    caption = (
        f"Growth with Nr at Nh = {rows[0]['Nh']}, {steps} load steps, {_repeats(rows)} "
        "repeats. (c): the condensed curve contains the factorisation, in which its "
        "work lies; the other does not. (d): everything from the mesh to u. Star and "
        f"cross: published for Nr = 30 ({published.MACHINE})."
    )
    return _section("figure6", "Scaling", scaling_figure(rows), caption)


def _final(experiment: Experiment) -> Section:
    fields = experiment.states["largest"]
    ends = ", ".join(
        f"{_plain(name)} {extent(fields, name).clipped / 1e9:.3g} "
        f"({extent(fields, name).largest / 1e9:.3g})"
        for name in STRESSES
    )
    rows = largest(experiment)
    caption = (
        f"Patch-recovered stresses at Nr = {rows[0]['Nr']}, Nh = {rows[0]['Nh']}, "
        "plane strain, on the deformed bodies (displacement × "
        f"{SCALE:g}); never averaged across bodies. Colours end at the "
        f"{PERCENTILE:g} % quantile of the nodal values' size, since stresses are "
        f"singular at corners; in GPa, the largest in brackets: {ends}."
    )
    picture = Picture(name="figure7", caption=caption, figure=stress_figure(fields))
    return Section(
        name="results",
        title="Final results",
        tables=(table_1(experiment), timings(experiment)),
        pictures=(picture,),
    )


def _plain(name: str) -> str:
    return {"sxx": "σx", "syy": "σy", "sxy": "τxy", "von_mises": "von Mises"}[name]


def _repeats(rows: Sequence[Row]) -> str:
    """Say how many repeats the medians are of: a number, or the range."""
    most: dict[tuple[Any, ...], int] = {}
    for row in rows:
        key = tuple(row.get(k) for k in ("Nr", "Nh", "method"))
        most[key] = max(most.get(key, 0), 1 + int(row["repeat"]))
    low, high = min(most.values()), max(most.values())
    return str(low) if low == high else f"{low} to {high}"


def _section(name: str, title: str, figure: Any, caption: str) -> Section:
    picture = Picture(name=name, caption=caption, figure=figure)
    return Section(name=name, title=title, pictures=(picture,))
