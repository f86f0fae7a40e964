"""What there is: solvers, families of problems, suites."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import fields
from functools import cache
from html import escape
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mortarbench.harness.names import completed
from mortarbench.harness.plugin import About, Solver
from mortarbench.harness.registry import options_of
from mortarbench.registries import Plugins, Registries, known
from mortarbench.solvers import SOLVERS
from mortarbench.text import first_comment, first_sentence, listing

if TYPE_CHECKING:
    from pandas import DataFrame

#: what `list solvers` says of our solvers, so that it need not import all of them;
#: written by `make docs`, and a test compares it with the solvers
CATALOGUE = Path(__file__).with_name("catalogue.json")


class Listing(tuple[Mapping[str, Any], ...]):
    """Rows of plain data; a table where it is shown."""

    __slots__ = ()

    @property
    def names(self) -> tuple[str, ...]:
        """The name of each row."""
        return tuple(row["name"] for row in self)

    @property
    def df(self) -> DataFrame:
        """The same as a table of pandas."""
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
        return f"<table><tr><th>name</th><th>what it is</th></tr>{rows}</table>"


def solvers(*, plugins: Plugins = (), registries: Registries | None = None) -> Listing:
    """List the solvers: name, description, options with their defaults.

    plugins : Python files with more of them

    Raises
    ------
    InputError
        When a plug-in cannot be loaded.

    """
    registries = known(plugins, registries)
    entries = getattr(registries.solvers, "entries", {})
    return Listing(
        _row(
            name,
            catalogue()[name]
            if name in SOLVERS and entries.get(name) is SOLVERS.entries[name]
            else described(registries.solvers[name]),
        )
        for name in registries.solvers
    )


def problems(*, plugins: Plugins = (), registries: Registries | None = None) -> Listing:
    """List the families: name, description, keys with their defaults, forms.

    plugins : Python files with more of them

    Raises
    ------
    InputError
        When a plug-in cannot be loaded.

    """
    registries = known(plugins, registries)
    return Listing(
        {
            "name": name,
            "description": first_sentence(family),
            "defaults": completed(family, {}),
            "forms": family.forms,
        }
        for name, family in registries.families.items()
    )


def suites(*, registries: Registries | None = None) -> Listing:
    """List the suites that come with us: name, description, path."""
    folder = known((), Registries() if registries is None else registries).suites
    return Listing(
        {"name": path.stem, "description": first_comment(path), "path": str(path)}
        for path in sorted(folder.glob("*.toml"), key=attrgetter("stem"))
    )


def described(solver: Solver) -> dict[str, Any]:
    """Give what a list says of a solver, as plain data."""
    facts = about(solver)
    return {
        "about": None
        if facts is None
        else {f.name: getattr(facts, f.name) for f in fields(About)},
        "sentence": first_sentence(solver),
        "options": options_of(solver),
    }


def _row(name: str, entry: Mapping[str, Any]) -> dict[str, Any]:
    """Say what a solver is, in a line, and what it lacks to be used here."""
    line = entry["sentence"]
    if entry["about"] is not None:
        facts = About(**entry["about"])
        parts = [f"{facts.title}, {facts.method}", facts.missing]
        line = "; ".join(filter(None, parts))
    return {"name": name, "description": line, "options": entry["options"]}


@cache
def catalogue() -> dict[str, Any]:
    """Read what is known of our own solvers without importing them."""
    found: dict[str, Any] = json.loads(CATALOGUE.read_text("utf-8"))
    return found


def about(solver: Solver) -> About | None:
    """Give the facts that a solver tells of itself, if it does."""
    facts = getattr(solver, "about", None)
    return facts if isinstance(facts, About) else None
