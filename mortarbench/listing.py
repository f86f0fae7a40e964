"""Lists of the available solvers, families of problems and suites."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields
from functools import cache
from html import escape
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mortarbench.harness.plugin import About, Solver
from mortarbench.harness.registry import options_of
from mortarbench.registries import Plugins, Registries, load_registries
from mortarbench.solvers import SOLVERS
from mortarbench.text import first_comment, first_sentence, listing

if TYPE_CHECKING:
    from pandas import DataFrame

#: File with descriptions of the built-in solvers, so that `list solvers` does not
#: import them. `make docs` writes the file, and a test compares its contents with the
#: solvers.
CATALOGUE = Path(__file__).with_name("catalogue.json")


class Listing(tuple[Mapping[str, Any], ...]):
    """Rows of plain data, displayed as a table in notebooks."""

    __slots__ = ()

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all rows."""
        return tuple(row["name"] for row in self)

    @property
    def df(self) -> DataFrame:
        """Rows as a pandas DataFrame."""
        from pandas import DataFrame

        return DataFrame(list(self))

    def __repr__(self) -> str:
        return listing(self) if self else "none"

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><td><code>{escape(row['name'])}</code></td>"
            f"<td style='text-align:left'>{escape(row['description'])}</td></tr>"
            for row in self
        )
        return f"<table><tr><th>name</th><th>description</th></tr>{rows}</table>"


def solvers(*, plugins: Plugins = (), registries: Registries | None = None) -> Listing:
    """List the solvers: name, description, and options with their defaults.

    plugins : Python files with more solvers
    registries : used instead of built-in registries, installed plug-ins and `plugins`

    Raises
    ------
    InputError
        If a plug-in cannot be loaded.

    Examples
    --------
    >>> import mortarbench as mb
    >>> [row["options"] for row in mb.solvers() if row["name"] == "qoco"]
    [{'max_iter': 200}]

    """
    registries = load_registries(plugins, registries)
    entries = getattr(registries.solvers, "entries", {})
    return Listing(
        _row(
            name,
            catalogue()[name]
            if name in SOLVERS and entries.get(name) is SOLVERS.entries[name]
            else describe(registries.solvers[name]),
        )
        for name in registries.solvers
    )


def problems(*, plugins: Plugins = (), registries: Registries | None = None) -> Listing:
    """List the families: name, description, keys with their defaults, and forms.

    plugins : Python files with more families
    registries : used instead of built-in registries, installed plug-ins and `plugins`

    Raises
    ------
    InputError
        If a plug-in cannot be loaded.

    Examples
    --------
    >>> import mortarbench as mb
    >>> [row["forms"] for row in mb.problems() if row["name"] == "obstacle"]
    [('primal', 'dual', 'dual-bounds')]

    """
    registries = load_registries(plugins, registries)
    return Listing(
        {
            "name": name,
            "description": first_sentence(family),
            "defaults": family.params,
            "forms": family.forms,
        }
        for name, family in registries.families.items()
    )


def suites(*, registries: Registries | None = None) -> Listing:
    """List the suites of the package: name, description and path.

    registries : used instead of the built-in registries

    Examples
    --------
    >>> import mortarbench as mb
    >>> "demo" in mb.suites().names
    True

    """
    folder = load_registries(
        (), Registries() if registries is None else registries
    ).suites
    return Listing(
        {"name": path.stem, "description": first_comment(path), "path": str(path)}
        for path in sorted(folder.glob("*.toml"), key=attrgetter("stem"))
    )


def describe(solver: Solver) -> dict[str, Any]:
    """Return the entry of a solver in the catalogue, as plain data."""
    facts = about(solver)
    return {
        "about": None
        if facts is None
        else {f.name: getattr(facts, f.name) for f in fields(About)},
        "sentence": first_sentence(solver),
        "options": options_of(solver),
    }


def _row(name: str, entry: Mapping[str, Any]) -> dict[str, Any]:
    """Return the row of a `Listing` that describes a solver.

    The description contains a remark if the library of the solver is missing.

    entry : entry of the solver in the catalogue, see `describe`
    """
    line = entry["sentence"]
    if entry["about"] is not None:
        facts = About(**entry["about"])
        parts = [f"{facts.title}, {facts.method}", facts.missing]
        line = "; ".join(filter(None, parts))
    return {"name": name, "description": line, "options": entry["options"]}


@cache
def catalogue() -> dict[str, Any]:
    """Read the catalogue of the built-in solvers, without importing the solvers."""
    entries: dict[str, Any] = json.loads(CATALOGUE.read_text("utf-8"))
    return entries


def about(solver: Solver) -> About | None:
    """Return the `About` of a solver, or None if the solver does not define one."""
    facts = getattr(solver, "about", None)
    return facts if isinstance(facts, About) else None
