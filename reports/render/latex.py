"""Tables as LaTeX, in the style of booktabs."""

from __future__ import annotations

import re

from mortarbench.reports.document.layout import Cell, Statement, Table

_NOT_IN_OT1 = "«»ÐðÞþ"

_SPECIAL = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "$": r"\$",
    "&": r"\&",
    "#": r"\#",
    "%": r"\%",
    "_": r"\_",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "|": r"\textbar{}",
    '"': r"\symbol{34}",
    "'": r"\textquotesingle{}",
    "`": r"\textasciigrave{}",
    "–": "--",
    "—": "---",
    "…": r"\ldots{}",
    "≤": r"$\leq$",
    "≥": r"$\geq$",
    "×": r"$\times$",
    "·": r"$\cdot$",
    "±": r"$\pm$",
    "≈": r"$\approx$",
    "∞": r"$\infty$",
    "√": r"$\surd$",
    "½": r"$\frac12$",
    "µ": r"$\mu$",
    "λ": r"$\lambda$",
    "ν": r"$\nu$",
    "°": r"$^\circ$",
    "∅": r"$\emptyset$",
    "✓": r"$\surd$",
    "−": r"$-$",
    "⋆": r"$\star$",
    "\0": "{}",
}

#: text that need not be escaped
_PLAIN = re.compile(r"(?!\[)(?:[A-Za-z0-9 .,:;()/=+?!@\[\]]|-(?!-))*")


#: maximum number of rows of a float; longer tables use longtable, which can break pages
ROWS = 36


def latex(
    tables: tuple[Table, ...], statements: tuple[Statement, ...] = (), name: str = ""
) -> str:
    r"""Render statements as a list, then tables; the first line names the packages.

    All tables need booktabs; tables of more than `ROWS` rows also need longtable. Times
    are printed with unit and interval; numbers without interval are plain (1.2e-9), in
    a format that siunitx can read.

    name : name of the section; the k-th table has the label tab:NAME-k, a single table
        has tab:NAME
    """
    long = any(len(table.rows) > ROWS for table in tables)
    packages = rf"% \usepackage{{booktabs{',longtable' * long}}}" + "\n"
    parts = [_statements(statements)] if statements else []
    for k, table in enumerate(tables, 1):
        number = f"-{k}" * (len(tables) > 1)
        parts.append(_table(table, f"tab:{name}{number}" if name else ""))
    return packages + "\n".join(parts)


def _statements(statements: tuple[Statement, ...]) -> str:
    items = [
        rf"  \item[{{{escaped(s.subject)}}}] "
        + " ".join(map(escaped, (*s.claims, *s.remarks)))
        for s in statements
    ]
    return "\n".join((r"\begin{description}", *items, r"\end{description}", ""))


def _table(table: Table, label: str) -> str:
    columns = "".join("lr"[not table.wordy(i)] for i in range(len(table.columns)))
    marked = rf"\label{{{label}}}" * bool(label)
    caption = rf"  \caption{{{escaped(table.legend)}}}{marked}"
    head = [r"    \toprule", _row([escaped(c) for c in table.columns]), r"    \midrule"]
    body = []
    before = ""
    for row in table.rows:
        if row[0].kind == "total" != before:
            body.append(r"    \midrule")
        before = row[0].kind
        body.append(_row([_cell(c) for c in row]))
    end = r"    \bottomrule"
    if len(table.rows) > ROWS:
        lines = [
            rf"\begin{{longtable}}{{{columns}}}",
            rf"{caption} \tabularnewline",
            *head,
            r"  \endfirsthead",
            *head,
            r"  \endhead",
            end,
            r"  \endfoot",
            *body,
            r"\end{longtable}",
            "",
        ]
    else:
        lines = [
            r"\begin{table}",
            r"  \centering",
            caption,
            rf"  \begin{{tabular}}{{{columns}}}",
            *head,
            *body,
            end,
            r"  \end{tabular}",
            r"\end{table}",
            "",
        ]
    return "\n".join(lines)


def _row(cells: list[str]) -> str:
    return f"    {' & '.join(cells)} \\\\"


def _cell(cell: Cell) -> str:
    text = escaped(cell.text)
    after = escaped(cell.after)
    match cell.kind:
        case "void":
            return f"{after} ({text})"
        case "best" | "over":
            text = rf"\textbf{{{text}}}"
        case "tied":
            text = rf"$\approx$ {text}"
    return f"{text} {after}".strip()


def escaped(text: str) -> str:
    """Escape for text mode; characters missing in OT1 become their code points.

    A leading bracket or asterisk is preceded by an empty group, because TeX would read
    it as an argument after the end of a row. Consecutive hyphens are separated, because
    TeX would combine them into dashes.
    """
    if _PLAIN.fullmatch(text):  # most cells of a large report
        return text
    hyphens = re.sub("-(?=-)", "-\0", text)
    safe = "".join(
        _SPECIAL.get(c)
        or (
            c
            if c.isascii() or ("¡" <= c <= "ÿ" and c not in _NOT_IN_OT1)
            else f"U+{ord(c):04X}"
        )
        for c in hyphens
    )
    return f"{{}}{safe}" if safe.startswith(("[", "*")) else safe
