"""The report as Markdown."""

from __future__ import annotations

import re

from mortarbench.reports.document.layout import Cell, Page, Section, Statement, Table
from mortarbench.reports.render.formulas import split

_MARKUP = re.compile(r"([\\`*_\[\]|~#$@])")
_LINK = re.compile(r"(:)(?=//)|(?<=www)(\.)", re.IGNORECASE)
_LIST = re.compile(r"^(\d*)([-+.)])(?=\s)")
#: text that needs escaping; most cells of a large report contain none
_ANY = re.compile(r"[&<>\\`*_\[\]|~#$@]|://|www\.|^\d*[-+.)]\s", re.IGNORECASE)


def markdown(page: Page) -> str:
    """Render the whole report, with links to figures and with pipe tables."""
    parts = [f"# {escaped(page.title)}", escaped(page.dateline)]
    for section in page.sections:
        parts += _section(section, page)
    return "\n\n".join(parts) + "\n"


def _section(section: Section, page: Page) -> list[str]:
    parts = [f"## {escaped(section.title)}"]
    parts += [_statement(one, page) for one in section.statements]
    parts += [_prose(p) for p in section.prose]
    if section.points:
        parts.append("\n".join(f"- {_prose(p)}" for p in section.points))
    for table in section.tables:
        parts += [_table(table), f"*{escaped(table.legend)}*"]
    for picture in section.pictures:
        caption = escaped(picture.caption)
        parts += [f"![{picture.name}](figures/{picture.name}.png)", f"*{caption}*"]
    return parts


def _prose(text: str) -> str:
    """Escape prose except its formulas, which are enclosed in dollars."""
    parts = split(text)
    parts[::2] = map(escaped, parts[::2])
    parts[1::2] = [f"${tex}$" for tex in parts[1::2]]
    return "".join(parts)


def _statement(statement: Statement, page: Page) -> str:
    """Render a statement as a paragraph that ends with links to its evidence."""
    links = [f"[{s.title}](#{_anchor(s.title)})" for s in page.sections_of(statement)]
    texts = map(escaped, (*statement.claims, *statement.remarks))
    evidence = f"Evidence: {', '.join(links)}." if links else ""
    return " ".join(
        filter(None, (f"**{escaped(statement.subject)}.**", *texts, evidence))
    )


def _anchor(title: str) -> str:
    """Return the anchor that Markdown generates for a heading."""
    return re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-")


def _table(table: Table) -> str:
    heads = [escaped(c) for c in table.columns]
    rule = [":--" if table.wordy(i) else "--:" for i in range(len(heads))]
    rows = [[_cell(c) for c in row] for row in table.rows]
    return "\n".join(f"| {' | '.join(row)} |" for row in (heads, rule, *rows))


def _cell(cell: Cell) -> str:
    text = escaped(f"{cell.symbol} {cell.text}".strip())
    if cell.kind == "void":
        text = f"~~{text}~~"
    elif text and cell.kind in {"best", "total", "over"}:
        text = f"**{text}**"
    return f"{text} {escaped(cell.after)}".strip()


def escaped(text: str) -> str:
    """Escape text that Markdown or HTML would read as markup, a link or a list."""
    if not _ANY.search(text):
        return text
    safe = text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")
    safe = _MARKUP.sub(r"\\\1", safe)
    safe = _LINK.sub(r"\\\g<0>", safe)
    return _LIST.sub(r"\1\\\2", safe)
