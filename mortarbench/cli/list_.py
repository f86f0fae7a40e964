"""The command `list`: list problems, solvers or suites; write docs/solvers.md."""

from __future__ import annotations

import ast
import inspect
import json
from argparse import Namespace
from collections.abc import Iterator, Mapping
from dataclasses import fields
from functools import cache
from textwrap import dedent
from typing import TYPE_CHECKING

from mortarbench import listing
from mortarbench.harness.errors import InputError
from mortarbench.harness.registry import options_of
from mortarbench.registries import Registries

if TYPE_CHECKING:
    from mortarbench.harness.plugin import Solver

HEAD = """\
# Solvers

**Which solvers are there, and which one do I choose?** `make docs` writes this page
from the adapters in `solvers/`, together with the notes on [our
solvers](solvers-own.md) and on [libraries](solvers-libraries.md).

Every solver is asked for the same accuracy: `tol`, the relative KKT accuracy of the
non-dimensional QP. The notes explain how each solver translates it to its own stopping
test. The claim of a solver is recorded beside our verdict and never trusted
([comparison policy](fair-play.md)).

| your QP | try first |
| --- | --- |
| bounds and equality rows only, such as a dual | `smalbe` |
| the same, dense, a few hundred unknowns or fewer | `smalbe-direct` |
| inequality rows, such as a primal form | `piqp`, `clarabel` |
| inequality rows, small and dense | `daqp` |
| bodies in subdomains (P is an operator) | `smalbe`; without contact `feti` |
| load steps and other sequences | *yes* in the column "sequences" |

`mortarbench test-solver NAME` runs the conformance suite on any of them, and on your
own solver with `--plugin FILE.py`. A solver whose library is missing declines, and
names the command that installs it; `make setup` installs all of them (the extra
`fleet`).

How units, order, scaled or repeated rows, an offset or a mirror change the answers is
measured in [weaknesses.md](weaknesses.md).
"""
OURS = """\
# Our solvers

Written by `make docs` from `solvers/`; change the docstrings there, not this file.
[Solvers](solvers.md) lists all.
"""
LIBRARIES = """\
# Solvers of libraries

Written by `make docs` from `solvers/adapters/`; change the docstrings there, not this
file. [Solvers](solvers.md) lists all, with the interfaces `qpsolvers:NAME` and
`cvxpy:NAME`.
"""


def run(registries: Registries, options: Namespace) -> int:
    """Print problems, solvers or suites, one line each or as one JSON array."""
    registries = registries.with_files(options.plugin)
    if options.markdown:
        if options.what != "solvers":
            raise InputError("--markdown is for list solvers only")
        print(solvers_page(registries.solvers), end="")
        return 0
    functions = {
        "problems": listing.problems,
        "solvers": listing.solvers,
        "suites": listing.suites,
    }
    rows = functions[options.what](registries=registries)
    print(json.dumps(list(rows)) if options.json else rows)
    return 0


def solvers_page(solvers: Mapping[str, Solver]) -> str:
    """Describe the solvers of a registry in Markdown, one section per class."""
    return "\n".join([HEAD, *_overview(solvers), *_sections(solvers).values()])


def solvers_pages(solvers: Mapping[str, Solver]) -> dict[str, str]:
    """Describe the solvers of a registry on several pages, by the names of their files.

    The first page has the table and the solvers with a backend of their own choice; the
    others have the sections of our solvers and of those of libraries.
    """
    pages: dict[str, list[str]] = {
        "solvers.md": [HEAD, *_overview(solvers)],
        "solvers-own.md": [OURS],
        "solvers-libraries.md": [LIBRARIES],
    }
    for kind, section in _sections(solvers).items():
        facts = listing.about(next(s for s in solvers.values() if type(s) is kind))
        if any(f.name == "backend" and f.default == "" for f in fields(kind)):
            pages["solvers.md"].append(section)
        elif facts and facts.package:
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
    """Return the table of options, with a column of values per name of a solver."""
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
        f"| --- |{' --- |' * (len(names) + 1)}",
    ]
    for option in options:
        values = " | ".join(f"{columns[name][option]!r}" for name in names)
        lines.append(f"| `{option}` | {values} | {meanings.get(option, '')} |")
    return [*lines, ""]


@cache
def _own_meanings(kind: type) -> dict[str, str]:
    try:
        source = dedent(inspect.getsource(kind))
    except (OSError, TypeError):  # not from a file
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
