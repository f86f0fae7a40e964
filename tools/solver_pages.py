"""Text of the pages docs/solvers*.md, from the docstrings in solvers/."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator, Mapping
from dataclasses import fields
from functools import cache
from textwrap import dedent
from typing import TYPE_CHECKING

from mortarbench import listing
from mortarbench.harness.registry import options_of

if TYPE_CHECKING:
    from mortarbench.harness.plugin import Solver

HEAD = """\
# Solvers

**Which solvers are available, and which one should I choose?** `make docs` generates
this page, the notes on [our solvers](solvers-own.md) and the notes on [solvers of
libraries](solvers-libraries.md) from the docstrings in `solvers/`.

Every solver is called with the same `tol`, the relative KKT accuracy of the
non-dimensional QP. The notes explain how each adapter translates `tol` to the stopping
criterion of its solver. The status that a solver claims is recorded, but whether its
answer is verified does not depend on this claim ([comparison policy](fair-play.md)).

| your QP | try first |
| --- | --- |
| bounds and equality rows only, such as a dual | `smalbe` |
| bounds and equality rows, dense, at most a few hundred unknowns | `smalbe-direct` |
| inequality rows, such as a primal form | `piqp`, `clarabel` |
| inequality rows, small and dense | `daqp` |
| decomposed bodies (P is an operator) | `smalbe` |
| load steps and other sequences | a solver with *yes* in the column "sequences" |

`mortarbench test-solver NAME` runs the conformance suite on one of these solvers, or on
your own solver with `--plugin FILE.py`. If the library of a solver is missing, the
solver declines, and the message states the command that installs the library; `make
setup` installs all libraries (the extra `fleet`).

`make weaknesses` shows how the answers of each solver change with the units, with the
order of unknowns and rows, with scaled or repeated rows, and with shifted or mirrored
unknowns.
"""
OURS = """\
# Our solvers

`make docs` generates this page from the docstrings in `solvers/`; change the
docstrings, not this file. [Solvers](solvers.md) lists all solvers.
"""
LIBRARIES = """\
# Solvers of libraries

`make docs` generates this page from the docstrings in `solvers/adapters/`; change the
docstrings, not this file. [Solvers](solvers.md) lists all solvers and describes the
interfaces `qpsolvers:NAME` and `cvxpy:NAME`.
"""


def solvers_pages(solvers: Mapping[str, Solver]) -> dict[str, str]:
    """Return the Markdown pages on the solvers of a registry, by name of the file.

    The first page contains the table of all solvers and the sections on solvers with a
    selectable backend. The other two pages contain the sections on built-in solvers and
    on solvers of libraries.
    """
    pages: dict[str, list[str]] = {
        "solvers.md": [HEAD, *_overview(solvers)],
        "solvers-own.md": [OURS],
        "solvers-libraries.md": [LIBRARIES],
    }
    for kind, section in _sections(solvers).items():
        if any(f.name == "backend" and f.default == "" for f in fields(kind)):
            pages["solvers.md"].append(section)
        elif ".adapters." in kind.__module__:
            pages["solvers-libraries.md"].append(section)
        else:
            pages["solvers-own.md"].append(section)
    return {name: "\n".join(parts) for name, parts in pages.items()}


def _sections(solvers: Mapping[str, Solver]) -> dict[type, str]:
    groups: dict[type, list[str]] = {}
    for name, solver in solvers.items():
        groups.setdefault(type(solver), []).append(name)
    return {kind: _section(kind, names, solvers) for kind, names in groups.items()}


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
