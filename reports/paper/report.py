"""Page with the figures and tables of the paper, and further ones, from stored data."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

from mortarbench.harness.results.experiment import Experiment, Row
from mortarbench.reports.data.evidence import Evidence, read_evidence
from mortarbench.reports.document.fields import FieldFigure
from mortarbench.reports.document.figure import Figure
from mortarbench.reports.document.formatting import (
    TIMED,
    clean,
    plural,
    seconds,
    significant,
)
from mortarbench.reports.document.layout import Page, Picture, Section
from mortarbench.reports.export.csv_tables import csv_tables as report_tables
from mortarbench.reports.export.csv_tables import frame_csv
from mortarbench.reports.figures.deformed import PERCENTILE, SCALE
from mortarbench.reports.paper import published
from mortarbench.reports.paper.bodies import (
    STRESSES,
    extent,
    geometry_figure,
    mesh_figure,
    stress_figure,
    zoom_figure,
)
from mortarbench.reports.paper.fleet import (
    DUALS,
    certified_figure,
    certified_table,
    fleet_figure,
    fleet_table,
    primal_dual_figure,
    totals_table,
)
from mortarbench.reports.paper.physics import (
    SINCE,
    active,
    orders,
    pressure_figure,
    stepping_figure,
    verification_figure,
)
from mortarbench.reports.paper.timings import (
    assembly_figure,
    contact_figure,
    csv_tables,
    here,
    inverse_figure,
    largest,
    of_table_1,
    pinv_fit,
    scaling_figure,
    select,
    table_1,
    times,
    timings,
)
from mortarbench.reports.render.html_page import html
from mortarbench.reports.render.latex import latex
from mortarbench.reports.render.writing import write_figures, write_text

REPEATED = (
    "Medians of interleaved, randomised repeats in separate worker processes, with "
    "the distribution-free 95 % interval of the median (below six repeats: minimum "
    "and maximum). Every answer is verified on the original QP, by its residuals; "
    "only verified answers have times."
)


def write_paper(folder: Path, experiment: Experiment) -> list[Path]:
    """Write index.html, figures/ (pdf, svg, png) and tables/ (csv, tex).

    The folder data/ contains result folders of the suites of `BEYOND`, if measured.
    Equal data yield identical bytes.

    Raises
    ------
    InputError
        If a result folder is damaged.

    """
    suites = {
        name: read_evidence(folder / "data" / name)
        for name in BEYOND
        if (folder / "data" / name).is_dir()
    }
    page = compose(experiment, suites)
    figures, drawings = write_figures(page, folder)
    tables = folder / "tables"
    written = [write_text(folder / "index.html", html(page, drawings)), *figures]
    written += [
        write_text(
            tables / f"{section.name}.tex", latex(section.tables, name=section.name)
        )
        for section in page.sections
        if section.tables
    ]
    frames = csv_tables(experiment)
    frames |= {name: report_tables(e)["outcomes"] for name, e in suites.items()}
    written += [
        write_text(tables / f"{name}.csv", frame_csv(frame))
        for name, frame in frames.items()
    ]
    return written


def compose(
    experiment: Experiment, suites: Mapping[str, Evidence] = MappingProxyType({})
) -> Page:
    """Compose the page: the sections of the paper, then further sections.

    suites : measured suites by name; those of `BEYOND` have sections
    """
    environment = experiment.setting["environment"]
    now = environment.get("now", {}).get("time", "")
    return Page(
        title="The paper's figures and tables",
        dateline=clean(
            f"{published.PAPER}. Measured {now} on "
            f"{here(environment.get('machine', {}))}; published times: "
            f"{published.MACHINE}.",
            400,
        ),
        sections=(
            _summary(largest(experiment)),
            *_bodies(experiment),
            *_times(experiment),
            _final(experiment),
            *_physics(experiment),
            *(
                section
                for name, of in BEYOND.items()
                if name in suites
                for section in of(suites[name])
            ),
            Section(
                name="errata", title="Errata of the paper", points=published.ERRATA
            ),
        ),
        footer="All samples are in data/ and their medians in tables/*.csv; the "
        "figures are drawn from these files only.",
    )


def _section(
    name: str, title: str, figure: Figure | FieldFigure, caption: str, **more: Any
) -> Section:
    """Return a section with one picture of the same name and further attributes."""
    picture = Picture(name=name, caption=caption, figure=figure)
    return Section(name=name, title=title, pictures=(picture,), **more)


def _summary(rows: Sequence[Row]) -> Section:
    Nr, Nh, n = (rows[0][k] for k in ("Nr", "Nh", "n"))
    ours, theirs = (
        times(rows, "n", method=m)[0].time for m in ("condensed", "per-row")
    )
    prose = (
        f"The complete analysis at Nr = {Nr}, Nh = {Nh} (n = {n}) takes "
        f"{seconds(ours)} with the dual condensed onto the interface and our SMALBE, "
        f"and {seconds(theirs)} with the paper's method: one solve per constraint row "
        "and load step, and textbook SMALBE. Both were measured in one interleaved run."
    )
    if of_table_1(rows):
        ratio = significant(published.TOTAL / ours.value)
        prose += (
            f" Published: {published.TOTAL:.2f} s ({published.MACHINE}), {ratio} times "
            "as long. This ratio includes the unknown influence of machine and "
            "language; methods should be compared on one machine."
        )
    return Section(
        name="summary",
        title="Summary",
        prose=(
            prose,
            "Times are medians of interleaved repeats in one process, with the "
            "distribution-free 95 % interval of the median in brackets and as bars "
            "(below six repeats: minimum and maximum, with lower coverage). Garbage "
            "collection is off. All methods, including those marked “the paper's "
            "method”, are our implementations, because the code of the paper is not "
            "public.",
        ),
    )


def _bodies(experiment: Experiment) -> tuple[Section, ...]:
    """Return the sections on geometry and mesh, Figures 1 and 2."""
    setting, states = experiment.setting, experiment.states
    E = {k: m["E"] / 1e9 for k, m in setting["materials"].items()}
    Nr, Nh = setting["plan"]["example"]
    one, two = (len(states[name].points) for name in ("example-Nh", "example-2Nh"))
    meshes = {
        f"$N_h$ layers: {one} nodes": states["example-Nh"],
        f"$2N_h$ layers: {two} nodes": states["example-2Nh"],
    }
    return (
        _section(
            "figure1",
            "Geometry",
            geometry_figure(states["example-2Nh"], setting["load"]),
            "Geometry, supports and load, drawn from the mesh. Hatched: clamped. "
            f"E = {E['beam']:g} GPa (A) and {E['ring']:g} GPa (B), "
            f"ν = {setting['materials']['beam']['nu']:g} in both bodies.",
        ),
        _section(
            "figure2",
            "Mesh and solution",
            mesh_figure(meshes),
            f"Mesh with Nr = {Nr}, Nh = {Nh} and its deformation (displacement × "
            f"{SCALE:g}) with two numbers of radial layers. (a), (b): Nh layers as in "
            f"the figure of the paper, {one} nodes (the paper: "
            f"{published.FIGURE_2_NODES}). (c), (d): 2·Nh layers as in its text and "
            f"Table 1, {two} nodes.",
        ),
    )


def _times(experiment: Experiment) -> tuple[Section, ...]:
    """Return the sections on times against size, Figures 3 to 6."""
    three, four, five, six = (experiment.tables[f"figure{i}"] for i in (3, 4, 5, 6))
    law = pinv_fit(five, "build")
    return (
        _section(
            "figure3",
            "Assembly",
            assembly_figure(three),
            "Assembly of the rectangle's stiffness matrix against its size, "
            f"{_repeats(three)} repeats (the paper: averages of 100 runs of the "
            "vectorised library [6]). Star: the only published value, 0.087 s, "
            f"for both bodies ({published.DOFS} dofs).",
        ),
        _section(
            "figure4",
            "Contact rows",
            contact_figure(four),
            "One linearisation of the contact at u = 0 against the slave segments "
            "(ring), a curve for each number of master segments (beam), "
            f"{_repeats(four)} repeats (the paper: averages of 10 runs). Star: a tenth "
            "of the published 2.064 s for ten steps with 240 master and 180 slave "
            f"segments ({published.MACHINE}).",
        ),
        _section(
            "figure5",
            "Generalised inverse",
            inverse_figure(five),
            "Generalised inverse of the rectangle's stiffness: construction (a), "
            f"multiplication with a random vector (b), {_repeats(five)} repeats (the "
            "paper: averages of 10 runs). The dense pseudoinverse is measured up to "
            f"n = {law.until:g}; the dotted line is the extrapolation c·n³ (a) "
            f"and c·n² (b), fitted to the sizes from {law.since:g} on; the band is the "
            "range of c over these sizes. The two inverses are different matrices (see "
            "the errata).",
        ),
        _section(
            "figure6",
            "Scaling",
            scaling_figure(six),
            f"Problem sizes and times against Nr at Nh = {six[0]['Nh']}, "
            f"{experiment.setting['plan']['steps']} load steps, {_repeats(six)} "
            "repeats. (c): the condensed curve includes the factorisation, which "
            "dominates its time; the other curve excludes it. (d): complete analysis. "
            f"Star and cross: published values for Nr = 30 ({published.MACHINE}).",
        ),
    )


def _repeats(rows: Sequence[Row]) -> str:
    """Return the number of repeats behind the medians, or its range."""
    most: dict[tuple[Any, ...], int] = {}
    for row in rows:
        key = tuple(row.get(k) for k in ("Nr", "Nh", "method"))
        most[key] = max(most.get(key, 0), 1 + int(row["repeat"]))
    return " to ".join(dict.fromkeys(str(f(most.values())) for f in (min, max)))


def _final(experiment: Experiment) -> Section:
    fields, rows = experiment.states["largest"], largest(experiment)
    names = {"sxx": "σx", "syy": "σy", "sxy": "τxy", "von_mises": "von Mises"}
    ends = ", ".join(
        f"{names[name]} {end.clipped / 1e9:.3g} ({end.largest / 1e9:.3g})"
        for name in STRESSES
        for end in [extent(fields, name)]
    )
    caption = (
        f"Patch-recovered stresses at Nr = {rows[0]['Nr']}, Nh = {rows[0]['Nh']}, "
        "plane strain, on the deformed bodies (displacement × "
        f"{SCALE:g}); not averaged across bodies. Colour scales end at the "
        f"{PERCENTILE:g} % quantile of absolute nodal values, since stresses are "
        f"singular at corners; ends in GPa, with maxima in brackets: {ends}."
    )
    picture = Picture(name="figure7", caption=caption, figure=stress_figure(fields))
    return Section(
        name="results",
        title="Final results",
        tables=(table_1(experiment), timings(experiment)),
        pictures=(picture,),
    )


def _physics(experiment: Experiment) -> tuple[Section, ...]:
    """Return the sections on the contact, both methods and accuracy of load steps."""
    tables, plan = experiment.tables, experiment.setting["plan"]
    followed = active(tables["pressures"], "nts")
    last = max(followed)
    zoom = (
        f"Contact at load step {last}, node-to-segment, to scale (displacement × 1). "
        "Orange: contact pressures on the nodes of the ring (dots), each along the "
        "normal of its contact row, with a scale arrow in the corner. The pressure is "
        "the nodal force over the undeformed arc length of the node."
    )
    pressures = (
        "Contact pressure against the angle around the centre of the ring, from "
        f"its right foot: (a) all {last} load steps, (b) both methods at the last. "
        f"(c): the active set, which grows from {plural(len(followed[1]), 'node')} to "
        f"{len(followed[last])} (node-to-segment; a node is active if its force "
        "exceeds 1e-6 of the largest)."
    )
    patch = select(tables["verification"], problem="patch")
    (left,) = select(patch, contact="nts", n=max(int(r["n"]) for r in patch))
    mortar = max(float(r["error"]) for r in select(patch, contact="mortar"))
    Nr, Nh = plan["stepped"]
    settled = tables["stepping"][-1]
    return (
        Section(
            name="contact",
            title="Beyond the paper: the contact",
            pictures=(
                Picture(
                    name="zoom",
                    caption=zoom,
                    figure=zoom_figure(experiment.states["largest"]),
                ),
                Picture(
                    name="pressure",
                    caption=pressures,
                    figure=pressure_figure(tables["pressures"]),
                ),
            ),
        ),
        Section(
            name="methods",
            title="Beyond the paper: node-to-segment against mortar",
            prose=(
                "The method called mortar in the paper is node-to-segment collocation. "
                "On its benchmark both methods yield nearly the same pressures (see "
                "the figure above); on problems with exact solutions they differ.",
            ),
            pictures=(
                Picture(
                    name="verification",
                    figure=verification_figure(tables["verification"]),
                    caption="Contact rows compared with exact solutions. (a): "
                    "largest error of σy at the Gauss points of the patch "
                    "test, in which 3 elements meet 2 (errors below 1e-12 are "
                    "due to rounding and are drawn at 1e-12). On the finest "
                    "mesh, this error is "
                    f"{100 * float(left['error']):.2g} % for node-to-segment, "
                    f"and at most {mortar:.0e} for mortar. (b): L² error of "
                    "the pressure between two cylinders relative to the "
                    "solution of Hertz. This error is at least of order a²/R², "
                    "because the bodies are finite.",
                ),
            ),
        ),
        _section(
            "stepping",
            "Beyond the paper: accuracy of the load steps",
            stepping_figure(tables["stepping"]),
            f"Error of the load steps at Nr = {Nr}, Nh = {Nh} (node-to-segment) "
            f"against their number. The reference has {settled['relin']} "
            f"linearisations in each of {settled['steps']} steps and satisfies the "
            "contact conditions linearised at the solution. The errors are due to "
            "the load steps alone, because every QP is solved up to rounding.",
            prose=(
                "The paper linearises the contact once per step, at the solution of "
                "the previous step, and does not state the error. The method is of "
                f"first order in 1/steps; fits use {SINCE} or more steps, with "
                "Student's interval.",
            ),
            tables=(orders(tables["stepping"]),),
        ),
    )


def _fleet(evidence: Evidence) -> tuple[Section, ...]:
    """Return the sections on times of the suite's solvers, against m and by form."""
    return (
        _section(
            "fleet",
            "Beyond the paper: SMALBE and other solvers",
            fleet_figure(evidence),
            "Times of verified answers against the size m of the dual at the last "
            "load step, tolerance 1e-6; crosses: unverified answers. Bars: "
            f"interval of the median. {TIMED}",
            prose=(REPEATED,),
            tables=tuple(fleet_table(evidence, form) for form in DUALS),
        ),
        _section(
            "totals",
            "Beyond the paper: primal against dual",
            primal_dual_figure(evidence),
            "Total times of the primal and dual forms, for verified answers only. "
            "Dual forms include the dualisation of one load step with the "
            "factorisation, which ten steps share. Crosses: unverified answers. "
            "SMALBE accepts only bounds and equalities, and therefore declines the "
            "primal form.",
            tables=(totals_table(evidence),),
        ),
    )


def _certified(evidence: Evidence) -> tuple[Section, ...]:
    """Return the section on time to certified accuracy."""
    n = max((o.size("dofs") or 0) for o in evidence.flat)
    caption = (
        "Certified relative error of the displacement in the energy norm against the "
        f"median time at n = {n}, one curve over the requested tolerances for each "
        "solver. The certificate is an upper bound that is computed from the answer "
        "alone, independently of the solver's claims."
    )
    return (
        _section(
            "certified",
            "Beyond the paper: time to certified accuracy",
            certified_figure(evidence),
            caption,
            prose=(REPEATED,),
            tables=(certified_table(evidence),),
        ),
    )


#: suite → function that returns its sections
BEYOND = {"paper-fleet": _fleet, "paper-accuracy": _certified}
