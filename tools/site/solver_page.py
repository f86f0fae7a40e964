"""Page of the site on the solvers, from the docstrings in solvers/."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator, Mapping
from functools import cache
from textwrap import dedent
from typing import TYPE_CHECKING

from mortarbench import listing
from mortarbench.harness.registry import options_of

if TYPE_CHECKING:
    from mortarbench.harness.plugin import Solver

HEAD = """\
# Solvers

**Which solvers are available, and which options do they have?** The docstrings in
`solvers/` describe each solver, and how its adapter translates `tol`, the relative
accuracy that all solvers receive, to the stopping test of its library. [Which
solver](compare.md#which-solver) helps to choose.

If the library of a solver is missing, the solver declines, and the message states the
command that installs the library; `make setup` installs all libraries (the extra
`fleet`). Beside the options listed here, a solver of a library has every setting of its
library under the library's own name.
"""


def solver_page(solvers: Mapping[str, Solver]) -> str:
    """Return the Markdown page on the solvers of a registry: a table, and sections."""
    groups: dict[type, list[str]] = {}
    for name, solver in solvers.items():
        groups.setdefault(type(solver), []).append(name)
    sections = (_section(kind, names, solvers) for kind, names in groups.items())
    return "\n".join([HEAD, *_overview(solvers), *sections])


def _overview(solvers: Mapping[str, Solver]) -> Iterator[str]:
    yield "| name | library | method | licence | sequences |"
    yield "| --- | --- | --- | --- | --- |"
    for name, solver in solvers.items():
        facts = listing.about(solver)
        cells = (
            [facts.title, facts.method, facts.licence] if facts else ["ours", "", ""]
        )
        chains = "yes" if hasattr(solver, "chain") else "no"
        yield f"| `{name}` | {' | '.join(cells)} | {chains} |"
    yield ""


def _section(kind: type, names: list[str], solvers: Mapping[str, Solver]) -> str:
    facts = listing.about(solvers[names[0]])
    title = facts.title if facts else kind.__name__
    lines = [f"## {title}", "", dedent(inspect.getdoc(kind) or ""), ""]
    if facts:
        rows = {
            "Install": f"`pip install {facts.package}`" if facts.package else "",
            "Method": facts.method,
            "Licence": facts.licence,
            "Linear solver": facts.linear_solver,
            "Phases": facts.phases,
            "Sequences": facts.sequence,
        }
        lines += [f"- {key}: {value}." for key, value in rows.items() if value]
        if facts.limits:
            lines += ["", "Known limits:", "", *(f"- {x}" for x in facts.limits)]
        lines.append("")
    lines += _options(kind, names, solvers)
    return "\n".join(lines)


def _options(kind: type, names: list[str], solvers: Mapping[str, Solver]) -> list[str]:
    """Return the table of options, with one column of values for each solver."""
    columns = {name: options_of(solvers[name]) for name in names}
    options = list(columns[names[0]])
    if not options:
        return []
    meanings: dict[str, str] = {}
    for base in kind.__mro__:
        meanings = {**_own_meanings(base), **meanings}
    heads = [f"`{name}`" for name in names]
    lines = [
        f"| option | {' | '.join(heads)} | |",
        f"|---|{'---|' * (len(names) + 1)}",
    ]
    for option in options:
        values = " | ".join(f"{columns[name][option]!r}" for name in names)
        lines.append(f"| `{option}` | {values} | {meanings.get(option, '')} |")
    return [*lines, ""]


@cache
def _own_meanings(kind: type) -> dict[str, str]:
    try:
        source = dedent(inspect.getsource(kind))
    except (OSError, TypeError):  # the class is not defined in a file
        return {}
    lines = source.splitlines()
    (body,) = ast.parse(source).body
    return {
        node.target.id: lines[node.end_lineno - 1].partition("#:")[2].strip()
        for node in getattr(body, "body", ())
        if isinstance(node, ast.AnnAssign)
        and isinstance(node.target, ast.Name)
        and node.end_lineno is not None
    }
