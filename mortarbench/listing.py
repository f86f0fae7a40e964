"""Lists of the available solvers, families of problems and suites."""

from __future__ import annotations

from collections.abc import Mapping
from operator import attrgetter
from typing import TYPE_CHECKING, Any

from mortarbench.harness.keys import keys_of
from mortarbench.harness.plugin import About, Solver
from mortarbench.harness.registry import options_of
from mortarbench.registries import Plugins, Registries, load_registries
from mortarbench.text import first_comment, first_sentence, listing

if TYPE_CHECKING:
    from pandas import DataFrame


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
    return Listing(
        {
            "name": name,
            "description": _description(solver),
            "options": options_of(solver),
        }
        for name, solver in registries.solvers.items()
    )


def problems(*, plugins: Plugins = (), registries: Registries | None = None) -> Listing:
    """List the families: name, description, keys, and forms.

    The row of a family contains the defaults of its keys, and under ``keys`` a text for
    each key: its range or its values, and its meaning. The default None means that the
    value follows from the file of the case.

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
            "keys": {key.name: str(key) for key in keys_of(type(family)).values()},
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
    folder = (registries or Registries()).suites
    return Listing(
        {"name": path.stem, "description": first_comment(path), "path": str(path)}
        for path in sorted(folder.glob("*.toml"), key=attrgetter("stem"))
    )


def _description(solver: Solver) -> str:
    """Return title and method, with a remark if the library is not installed."""
    if (facts := about(solver)) is None:
        return first_sentence(solver)
    parts = [f"{facts.title}, {facts.method}", facts.missing]
    return "; ".join(filter(None, parts))


def about(solver: Solver) -> About | None:
    """Return the `About` of a solver, or None if the solver does not define one."""
    facts = getattr(solver, "about", None)
    return facts if isinstance(facts, About) else None
