"""Page with the figures and tables of the paper, and further ones, from stored data."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pandas as pd

from mortarbench.harness.files.durable import replace_file
from mortarbench.harness.results.experiment import Experiment
from mortarbench.reports.document import (
    Document,
    Picture,
    Section,
    clean,
    plural,
    seconds,
)
from mortarbench.reports.figures.deformed import PERCENTILE
from mortarbench.reports.measurements import Measurements, read_measurements
from mortarbench.reports.paper import bodies, published
from mortarbench.reports.paper import timings as timed
from mortarbench.reports.paper.fleet import certified, fleet
from mortarbench.reports.writing import write_document

#: suite → function that returns its sections
BEYOND = {"paper-fleet": fleet, "paper-accuracy": certified}
TIMED = ("figure3", "figure4", "figure5", "figure6")  #: tables of repeated times
_TEXTS = tomllib.loads(Path(__file__).with_name("captions.toml").read_text("utf-8"))


def write_paper(folder: Path, experiment: Experiment) -> list[Path]:
    """Write index.html, figures/ (pdf, svg, png), tables/ (csv, tex), and data/ (csv).

    data/ contains all samples of the experiment and, if measured, result folders of
    the suites of `BEYOND`. Equal data yield identical bytes.

    Raises
    ------
    InputError
        If a result folder is damaged.

    """
    data = folder / "data"
    suites = {n: read_measurements(data / n) for n in BEYOND if (data / n).is_dir()}
    document = compose(experiment, suites)
    written = write_document(document, folder, ("html", "csv", "tex"))
    tables = {f"data/{name}": pd.DataFrame(t) for name, t in experiment.tables.items()}
    for name in TIMED:
        rows = tables[f"data/{name}"]
        keys = [*rows.columns.drop(["repeat", "seconds"])]
        tables[f"tables/{name}"] = timed.medians(rows, keys)
    for name, frame in tables.items():
        written.append(folder / f"{name}.csv")
        replace_file(written[-1], frame.to_csv(index=False).encode())
    return written


def compose(
    experiment: Experiment, suites: Mapping[str, Measurements] = MappingProxyType({})
) -> Document:
    """Compose the page: the sections of the paper, then further sections.

    suites : measured suites by name; those of `BEYOND` have sections
    """
    tables = {name: pd.DataFrame(list(t)) for name, t in experiment.tables.items()}
    setting, states = experiment.setting, experiment.states
    rows = tables["figure6"]
    largest, plan = rows[rows.Nr == rows.Nr.max()], setting["plan"]
    machine = timed.here(setting["environment"])
    now = setting["environment"].get("now", {}).get("time", "")
    meshes = {
        f"{layers} layers: {len(states[name].points)} nodes": states[name]
        for layers, name in (("$N_h$", "example-Nh"), ("$2N_h$", "example-2Nh"))
    }
    draw: dict[str, Any] = {
        "figure1": partial(
            bodies.geometry_figure, states["example-2Nh"], setting["load"]
        ),
        "figure2": partial(bodies.mesh_figure, meshes),
        "figure3": partial(timed.assembly_figure, tables["figure3"]),
        "figure4": partial(timed.contact_figure, tables["figure4"]),
        "figure5": partial(timed.inverse_figure, tables["figure5"]),
        "figure6": partial(timed.scaling_figure, rows),
        "figure7": partial(bodies.stress_figure, states["largest"]),
        "zoom": partial(bodies.zoom_figure, states["largest"]),
    }
    results = (
        timed.table_1(tables["table1"]), timed.timings(largest, plan["steps"], machine)
    )  # fmt: skip
    numbers = facts(experiment, tables)
    sections = [_summary(largest)]
    for name, text in _TEXTS.items():
        caption = text["caption"].format(**numbers)
        picture = Picture(name=name, caption=caption, draw=draw[name])
        items = (*results, picture) if name == "figure7" else (picture,)
        sections.append(Section(name=name, title=text["title"], items=items))
    solvers = tuple(dict.fromkeys(s for of in suites.values() for s in of.solvers))
    for name, of in BEYOND.items():
        sections += of(suites[name], solvers) if name in suites else ()
    errata = Section(name="errata", title="Errata of the paper", items=published.ERRATA)
    return Document(
        title="The paper's figures and tables",
        dateline=clean(f"{published.PAPER}. Measured {now} on {machine}.", 400),
        sections=(*sections, errata),
        solvers=solvers,
        footer="All samples are in data/, and their medians in tables/*.csv.",
    )


def facts(experiment: Experiment, tables: Mapping[str, pd.DataFrame]) -> dict[str, Any]:
    """Return the numbers in the captions."""
    plan, states = experiment.setting["plan"], experiment.states
    beam, ring = (experiment.setting["materials"][name] for name in ("beam", "ring"))
    ends = (
        f"({letter}) {clipped / 1e9:.3g} ({largest / 1e9:.3g})"
        for letter, name in zip("abcd", bodies.STRESSES, strict=True)
        for clipped, largest in [bodies.extent(states["largest"], name)]
    )
    return {
        **plan,
        "Nr": max(plan["scaling"]),
        "E_beam": beam["E"] / 1e9,
        "E_ring": ring["E"] / 1e9,
        "nu": beam["nu"],
        "nodes_one": len(states["example-Nh"].points),
        "nodes_two": len(states["example-2Nh"].points),
        "repeats": {name: _repeats(tables[name]) for name in TIMED},
        "dense": tables["figure5"].query("method == 'pinv'").n.max(),
        "percentile": PERCENTILE,
        "ends": ", ".join(ends),
    }


def _repeats(rows: pd.DataFrame) -> str:
    """Return the number of repeats behind the medians, or its range."""
    most = rows.groupby([*rows.columns.drop(["repeat", "seconds"])]).repeat.max() + 1
    least = f"{most.min()} to " if most.min() < most.max() else ""
    return f"{least}{plural(int(most.max()), 'repeat')}"


def _summary(rows: pd.DataFrame) -> Section:
    total = timed.medians(rows, ["method"]).set_index("method")["median"]
    first = rows.iloc[0]
    items = (
        f"The complete analysis at Nr = {first.Nr}, Nh = {first.Nh} (n = {first.n}) "
        f"takes {seconds(total['condensed'])} with the dual condensed onto the "
        f"interface and our SMALBE, and {seconds(total['per-row'])} with the paper's "
        "method: one solve per constraint row and load step, and textbook SMALBE. "
        f"Published for Nr = 30, Nh = 15: {published.TOTAL:.2f} s on another machine.",
        "Times are medians of interleaved repeats in one process, with the "
        "distribution-free 95 % interval of the median (below six repeats: minimum and "
        "maximum). All methods, including those marked “the paper's method”, are our "
        "implementations, because the code of the paper is not public.",
    )
    return Section(name="summary", title="Summary", items=items)
