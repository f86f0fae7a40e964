"""Hostile names do not break tables or figures in any format."""

import csv
import re
import unicodedata
from html import unescape

import pytest

from mortarbench.harness import Record, Verdict
from mortarbench.harness.results.journal import Journal
from mortarbench.reports.document import _md as md
from mortarbench.reports.document import _tex as tex
from mortarbench.reports.document import clean
from mortarbench.reports.folder import write_report

pytestmark = pytest.mark.together  # one report for all names

NAMES = (
    "<b onmouseover=a()>&amp;</b><!--",
    r"\end{table}\input|x$^^M%",
    "=HYPERLINK(\"http://evil.example\")",
    "\u202ertl \u0645\u0631\u062d\u0628\u0627 \u2066\u2069",
    "z" + "\u0335\u0321\u0322" * 40 + "algo",
    "\u0301begins with an accent",
    "zero\u200bwidth\u200d\ufeff\u00ad",
    "family 👨\u200d👩\u200d👧 and flag 🇨🇿",
    "bell\x07 null\x00 escape\x1b[31m return\r\nnew\u2028line\u0085",
    "lone \ud800 surrogate",
    "1. - + # not a list",
    "http://evil.example www.evil.example me@evil.example",
    "", " ", "x" * 10_000, "+1", "-1", "@SUM(1)", "\t=1+1", "\r=1", " =1", "\uff1d1",
    "\u200b=1", "1;=1",
)  # fmt: skip


@pytest.fixture(
    scope="module", params=["blank", pytest.param("drawn", marks=pytest.mark.slow)]
)
def report(request, tmp_path_factory, svg_only, blank):
    """Return a report with all names, by default with empty figures."""
    folder = tmp_path_factory.mktemp("hostile")
    with Journal(folder, "test") as journal:
        for i, name in enumerate(NAMES):
            for size in (10, 20, 40):
                journal.append(Record(
                    run_id=f"{i}-{size}{name}", case=f"{name}/{size}", family=name,
                    params={name: size}, form=name, sizes={"variables": size},
                    solver=name, options={name: name}, tol=1e-6, repeat=0, block=0,
                    status=Verdict.WRONG if i % 2 else Verdict.VERIFIED, claimed=name,
                    message=name, iterations=size, counts={name: 3},
                    total_seconds=size / 1e4, primal=1e-9, dual=1e-9, gap=1e-9,
                    complementarity=1e-9, quantities={"dofs": size, name: name},
                    environment=name, started=name,
                ))  # fmt: skip
    with svg_only() if request.param == "drawn" else blank():
        write_report(folder, ["html", "md", "tex", "csv"])
    return folder / "report"


@pytest.mark.parametrize("name", NAMES, ids=range(len(NAMES)))
def test_a_clean_name_is_one_short_visible_line(name):
    shown = clean(name)
    assert len(shown) <= 96
    assert not re.search(r"[\n\r\x00-\x1f\x7f-\x9f\u2028\u2029]", shown)
    assert not {"Cc", "Cf", "Cs"} & {unicodedata.category(c) for c in shown}
    marks = "".join("m" if unicodedata.combining(c) else "." for c in shown)
    assert "mmm" not in marks  # more accents would reach into adjacent rows
    assert not marks.startswith("m")  # an accent would join the preceding character


def test_names_that_differ_invisibly_do_not_look_the_same():
    assert clean("solver\u200b") != clean("solver")


def test_every_row_of_every_latex_table_has_its_columns(report):
    for path in (report / "tables").glob("*.tex"):
        columns = 0
        for line in path.read_text("utf-8").splitlines():
            if begun := re.search(r"\\begin\{tabular\}\{@\{\}([lr]+)@\{\}\}", line):
                columns = len(begun[1])
            if line.endswith(r"\\"):
                body = line.removesuffix(r"\\")
                assert len(re.findall(r"(?<!\\)&", body)) == columns - 1, line
                assert not re.search(r"(?<!\\)[%#]", body), line
            assert line.count(r"\end{table}") == (line == r"\end{table}"), line


@pytest.mark.parametrize(
    ("name", "printed"),
    [
        ('say "so"', "say ''so''"),  # OT1 has no \textquotedbl
        ("æλ♥", r"æ$\lambda$U+2665"),
        ("1.2e-9, 1e-6", r"1.2$\cdot10^{-9}$, $10^{-6}$"),
        ("7/7 · m^1.5", r"7/7 $\cdot$ $m^{1.5}$"),
        ("[1, 2]", "{}[1, 2]"),  # an optional argument of the row above
    ],
)
def test_latex_prints_all_characters_without_further_packages(name, printed):
    assert tex(name) == printed


def test_every_row_of_a_markdown_table_has_its_columns_and_links_nowhere(report):
    text = (report / "report.md").read_text("utf-8")
    for block in re.findall(r"(?:^\|.*\n)+", text, flags=re.MULTILINE):
        counts = {len(re.findall(r"(?<!\\)\|", r)) for r in block.splitlines()}
        assert len(counts) == 1
    assert not re.search(r"<(?!br>)[a-z/!]", text)
    assert not re.search(r"http://|www\.|\w@\w", text)


@pytest.mark.parametrize("name", ["1. x", "1) x", "- x", "+ x"])
def test_names_do_not_become_lists_in_markdown(name):
    assert re.match(r"\d*\\[-+.)] x$", md(name))


def test_markdown_does_not_escape_numbers():
    assert [md(n) for n in ("-1.5e-3", "1.25", "3")] == ["-1.5e-3", "1.25", "3"]


#: names that CSV files contain in another form
IN_CSV = {
    '=HYPERLINK("http://evil.example")': "'=HYPERLINK(\"http://evil.example\")",
    "\u202ertl \u0645\u0631\u062d\u0628\u0627 \u2066\u2069":
        "\\u202ertl \u0645\u0631\u062d\u0628\u0627 \\u2066\\u2069",
    "bell\x07 null\x00 escape\x1b[31m return\r\nnew\u2028line\u0085":
        r"bell\x07 null\x00 escape\x1b[31m return\r\nnew\u2028line\x85",
    "lone \ud800 surrogate": r"lone \ud800 surrogate",
    "+1": "'+1", "-1": "'-1", "@SUM(1)": "'@SUM(1)", "\t=1+1": r"\t=1+1",
    "\r=1": r"\r=1", " =1": "' =1", "\uff1d1": "'\uff1d1", "\u200b=1": r"\u200b=1",
    "1;=1": "1;=1", "zero\u200bwidth\u200d\ufeff\u00ad":
        "zero\\u200bwidth\u200d\\ufeff\\xad",
}  # fmt: skip


def test_csv_contains_names_as_text_and_numbers_as_numbers(report):
    with (report / "tables" / "measurements.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 3 * len(NAMES)
    wanted = {IN_CSV.get(name, name) for name in NAMES}
    for column in ("solver", "claimed", "family", "message"):
        assert {row[column] for row in rows} == wanted
    assert {float(row["total_seconds"]) for row in rows} == {1e-3, 2e-3, 4e-3}
    assert {row["tol"] for row in rows} == {"1e-06"}


def is_formula(cell):
    is_rule = set(cell) <= set("-:")  # rule of Markdown, or LaTeX's dash for no value
    is_number = re.fullmatch(r"-[0-9.]+(e-?[0-9]+)?", cell)
    return cell[:1] in tuple("=+-@") and not (is_rule or is_number)


def test_no_cell_of_any_table_is_a_formula(report):
    cells = []
    for path in (report / "tables").glob("*.csv"):
        with path.open(newline="") as file:
            cells += [cell for row in csv.reader(file) for cell in row]
    text = (report / "report.md").read_text("utf-8")
    for row in re.findall(r"^\| (.*) \|$", text, flags=re.MULTILINE):
        cells += [c.replace("\\", "").strip("*~ ") for c in re.split(r" \| ", row)]
    for path in (report / "tables").glob("*.tex"):
        rows = re.findall(r"^ +(.*) \\\\$", path.read_text("utf-8"), flags=re.MULTILINE)
        cells += [c.removeprefix(r"\textbf{") for row in rows for c in row.split(" & ")]
    page = (report / "index.html").read_text("utf-8")
    cells += [unescape(c) for c in re.findall(r"<t[dh][^>]*>(?:<[^>]*>)*([^<]*)", page)]

    assert len(cells) > 1000
    assert [cell for cell in cells if is_formula(cell)] == []


def test_the_page_contains_no_invisible_characters(report):
    text = (report / "index.html").read_text("utf-8")
    hiding = {c for c in text if unicodedata.category(c) in {"Cf", "Cs", "Zl", "Zp"}}
    controls = {c for c in text if unicodedata.category(c) == "Cc"}
    assert hiding == set()
    assert controls <= {"\n"}
