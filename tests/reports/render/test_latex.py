"""LaTeX tables: labels, tables of many pages, and compilation of all tables."""

import re
import shutil
import subprocess

import pytest

from mortarbench.reports.document.layout import Cell, Statement, Table
from mortarbench.reports.folder import write_report
from mortarbench.reports.render.latex import ROWS, escaped, latex
from tests.support.synthetic_results import write

NASTY = r"\input{x}_^$#&%~{}[1] ‖u − û‖ ≤ 1e-8, µ½λ 'a' `b` --- <c> |d| 漢"


def table(rows, caption="Times."):
    return Table(
        caption=caption,
        columns=("case", "time"),
        rows=tuple((Cell(text=f"case {i}"), Cell(text=f"{i}")) for i in range(rows)),
    )


def compiled(folder, body):
    """Run pdflatex on a document; return the number of pages, or fail with its log."""
    source = folder / "main.tex"
    source.write_text(
        "\\documentclass{article}\n\\usepackage[utf8]{inputenc}\n"
        "\\usepackage[T1]{fontenc}\n\\usepackage{booktabs,longtable}\n"
        f"\\begin{{document}}\n{body}\n\\end{{document}}\n",
        "utf-8",
    )
    command = ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", source.name]
    for _ in range(2):  # longtable and \ref need two runs
        done = subprocess.run(
            command, cwd=folder, capture_output=True, timeout=300, check=False
        )
    log = (folder / "main.log").read_text("latin-1")
    assert done.returncode == 0, log[-2000:]
    assert not re.search(r"multiply[- ]defined|undefined", log), log[-2000:]
    return int(re.search(r"Output written on .*?\((\d+) page", log, re.DOTALL)[1])


def test_every_table_of_a_section_has_its_own_label():
    text = latex((table(2), table(3)), name="times")
    assert re.findall(r"\\label\{(.*?)\}", text) == ["tab:times-1", "tab:times-2"]
    assert r"\caption{Times.}\label{tab:times}" in latex((table(2),), name="times")


def test_a_long_table_is_a_longtable():
    short, long = latex((table(ROWS),), name="a"), latex((table(ROWS + 1),), name="a")
    assert r"\begin{table}" in short
    assert short.startswith("% \\usepackage{booktabs}\n")
    assert r"\begin{longtable}{lr}" in long
    assert long.startswith("% \\usepackage{booktabs,longtable}\n")
    assert long.count(r"\toprule") == 2  # for the first page, and for the other pages
    assert r"\begin{table}" not in long
    assert len(re.findall(r"case \d+ &", long)) == ROWS + 1


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no pdflatex (texlive)")
def test_tex_compiles_hostile_names_and_tables_of_many_pages(tmp_path):
    hostile = Table(
        caption=NASTY, columns=(NASTY, NASTY),
        rows=((Cell(text=NASTY), Cell(text=NASTY, after=NASTY, kind="void")),) * 3,
    )  # fmt: skip
    said = (Statement(subject=NASTY, claims=(NASTY,), remarks=(NASTY,)),)
    body = latex((hostile, table(200)), said, "hostile")
    pages = compiled(
        tmp_path, body + r"Tables \ref{tab:hostile-1}, \ref{tab:hostile-2}"
    )
    assert pages >= 4
    assert escaped(NASTY) in body


@pytest.mark.slow
@pytest.mark.usefixtures("only_svg")
@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="no pdflatex (texlive)")
def test_tex_compiles_all_tables_of_a_report(tmp_path):
    folder = write(tmp_path / "run", 4, 40, 3)
    files = [p for p in write_report(folder, ["tex"]) if p.suffix == ".tex"]
    assert len(files) > 8
    labels = [x for p in files for x in re.findall(r"\\label\{(.*?)\}", p.read_text())]
    assert len(set(labels)) == len(labels) > 8
    body = "\n\\clearpage\n".join(p.read_text("utf-8") for p in files)
    assert compiled(tmp_path, body) > len(files)
