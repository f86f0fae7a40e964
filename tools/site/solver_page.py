"""Page of the site on the solvers, from the docstrings in solvers/."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Mapping
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
#: field of a class with a comment ``#:`` on its last line
FIELD = re.compile(r"^    (\w+): [^#\n]*(?:\n {8}[^#\n]*)?  #: (.*)$", re.MULTILINE)


def table(*rows: Iterable[str]) -> str:
    """Return a Markdown table; the first row contains the heads of the columns."""
    lines = [
        f"| {' | '.join(c.replace('|', chr(92) + '|') for c in r)} |" for r in rows
    ]
    return "\n".join([lines[0], re.sub(r"[^|]+", " --- ", lines[0]), *lines[1:]])


def solver_page(solvers: Mapping[str, Solver]) -> str:
    """Return the Markdown page on the solvers of a registry: a table, and sections."""
    groups: dict[type, list[str]] = {}
    rows = [("name", "library", "method", "licence", "sequences")]
    for name, solver in solvers.items():
        groups.setdefault(type(solver), []).append(name)
        facts = listing.about(solver)
        cells = (facts.title, facts.method, facts.licence) if facts else ("", "", "")
        rows.append((f"`{name}`", *cells, "yes" if hasattr(solver, "chain") else "no"))
    parts = [HEAD, table(*rows)]
    for kind, names in groups.items():
        parts += _section(kind, {name: solvers[name] for name in names})
    return "\n\n".join(parts) + "\n"


def _section(kind: type, solvers: Mapping[str, Solver]) -> list[str]:
    """Return title, docstring, facts and options of the solvers of a class."""
    facts = listing.about(next(iter(solvers.values())))
    parts = [
        f"## {facts.title if facts else kind.__name__}",
        inspect.getdoc(kind) or "",
    ]
    if facts:
        lines = {
            "Install": facts.package and f"`pip install {facts.package}`",
            "Linear solver": facts.linear_solver,
            "Phases": facts.phases,
            "Sequences": facts.sequence,
            "Known limits": " ".join(facts.limits),
        }
        parts.append("\n".join(f"- {key}: {v}" for key, v in lines.items() if v))
    meanings: dict[str, str] = {}
    for base in reversed(kind.__mro__[:-1]):
        meanings |= FIELD.findall(inspect.getsource(base))
    values = {name: options_of(solver) for name, solver in solvers.items()}
    if options := list(next(iter(values.values()))):
        heads = ("option", *(f"`{name}`" for name in solvers), "")
        rows = (
            (f"`{o}`", *(repr(v[o]) for v in values.values()), meanings.get(o, ""))
            for o in options
        )
        parts.append(table(heads, *rows))
    return parts
