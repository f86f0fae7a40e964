"""Contents of reports agree with the journal, also for hostile names."""

import csv
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from mortarbench.harness import Fields, InputError, Record, Verdict
from mortarbench.harness.files.store import save_fields
from mortarbench.harness.results.journal import Journal
from mortarbench.problems.fem.mesh import box
from mortarbench.reports import write_report
from mortarbench.reports.data.evidence import Evidence, arrange
from mortarbench.reports.data.quantities import spreads
from mortarbench.reports.data.size_series import size_series
from mortarbench.reports.document import layout
from mortarbench.reports.document.formatting import (
    clean,
    exponent,
    seconds,
    significant,
)
from mortarbench.reports.folder import compose
from mortarbench.reports.render.html_page import breakable
from mortarbench.reports.render.latex import escaped, latex
from mortarbench.reports.render.markdown import escaped as md_escaped
from mortarbench.reports.render.markdown import markdown
from mortarbench.reports.render.writing import write_figures
from mortarbench.reports.sections.summary import sentences
from mortarbench.reports.statistics.intervals import power_law

pytestmark = pytest.mark.together

HOSTILE = (
    '<script>alert(1)</script>"><img src=http://evil.example/x onerror=alert(1)>',
    r"\input{/etc/passwd}$^$_#&%~{}",
    "| a | b |\n## heading\n",
    "ünïcødé 漢字 🙂 \u202eright-to-left\x00\x1b[31m",
    "_hidden $x^2",
    "long" * 2500,
)


@pytest.fixture(scope="module")
def measured():
    """Return a factory of records of beam-ring/size=N/FORM, by default verified."""

    def make(solver="a", size=10, repeat=0, *, form="dual", **changes):
        defaults = dict(
            run_id=f"{solver[:20]}-{form}-{size}-{changes.get('tol', 1e-8)}-{repeat}",
            case=f"beam-ring/size={size}/{form}", family="beam-ring",
            params={"size": size}, form=form, sizes={"variables": size},
            solver=solver, options={"max_iter": 100}, tol=1e-8, repeat=repeat,
            block=repeat, status=Verdict.VERIFIED, claimed="solved", iterations=7,
            prepare_seconds=0.001, solve_seconds=0.002, total_seconds=0.003,
            primal=1e-9, dual=2e-9, complementarity=3e-10, gap=4e-11,
            quantities={"dofs": 2 * size, "equality_rows": 4, "contact_rows": size,
                        "energy": -12345.678901234, "tip": [0.25, -0.5]},
            environment="abc", started="2026-11-21T10:00:00+00:00",
        )  # fmt: skip
        return Record(**(defaults | changes))

    return make


@pytest.fixture
def evidence(tmp_path):
    def make(records, **more):
        return Evidence(directory=tmp_path, records=arrange(records), **more)

    return make


def write(folder, records):
    folder.mkdir(exist_ok=True)
    with Journal(folder, "test") as journal:
        for record in records:
            journal.append(record)
    return folder


def table(page, section, number=0):
    """Return the rows of one table as dicts from column to cell."""
    (found,) = (s for s in page.sections if s.name == section)
    chosen = found.tables[number]
    return [dict(zip(chosen.columns, row, strict=True)) for row in chosen.rows]


def timed(measured, solver, times, **changes):
    return [
        measured(solver, repeat=i, total_seconds=t, **changes)
        for i, t in enumerate(times)
    ]


def test_an_unverified_answer_is_never_the_fastest(measured, evidence):
    records = [
        *timed(measured, "honest", [0.030, 0.031, 0.032]),
        *timed(measured, "liar", [0.001, 0.001, 0.001], status=Verdict.WRONG),
    ]
    (row,) = table(compose(evidence(records)), "times")
    assert row["honest"].kind == "best"
    assert (row["liar"].kind, row["liar"].after) == ("void", "wrong")
    assert row["liar"].value is None  # without a value, it is not sorted with times


def test_one_unverified_repeat_voids_the_time(measured, evidence):
    records = timed(measured, "a", [0.01, 0.01, 0.01])
    records[1] = records[1].replace(status=Verdict.INACCURATE)
    page = compose(evidence(records))
    assert table(page, "times")[0]["a"].kind == "void"
    assert table(page, "verdicts")[0]["a"].text == "inaccurate (1 of 3 repeats)"


def test_the_median_decides_and_overlapping_intervals_are_a_tie(measured, evidence):
    records = [
        *timed(measured, "steady", [0.010, 0.010, 0.011]),
        *timed(measured, "shaky", [0.001, 0.012, 0.090]),
        *timed(measured, "slow", [0.020, 0.021, 0.022]),
    ]
    (row,) = table(compose(evidence(records)), "times")
    kinds = {solver: row[solver].kind for solver in ("steady", "shaky", "slow")}
    assert kinds == {"steady": "best", "shaky": "tied", "slow": ""}
    assert row["shaky"].text == "12.0 ms [1.0, 90.0]"


def test_no_time_is_printed_without_its_uncertainty(measured, evidence):
    records = [
        measured(solver, size, i, total_seconds=(i + 1.7) * scale * size)
        for solver, scale in (("a", 1e-6), ("b", 1e-3), ("c", 1.0))
        for size in (10, 20, 40)
        for i in range(3)
    ] + [measured("once", 10, total_seconds=0.5)]
    text = markdown(compose(evidence(records)))
    times = re.findall(r"\d (?:s|ms|µs)\b(.{4})", text)
    assert len(times) == 2 * (9 + 1)  # in the sections on times and on scaling
    assert all(re.match(r" \\\[[\d]", after) for after in times)
    assert "500 ms \\[1 run\\]" in text
    assert "probability 0.75 for 3 repeats" in text


def test_times_have_unit_and_significant_digits():
    from mortarbench.reports.statistics.intervals import median_interval

    assert seconds(median_interval([0.0119, 0.0123, 0.0140])) == "12.3 ms [11.9, 14.0]"
    assert seconds(median_interval([1.5, 1.25, 100.0])) == "1.50 s [1.25, 100.00]"
    assert seconds(median_interval([2e-7, 2e-7, 3e-7])) == "0.200 µs [0.200, 0.300]"


def test_energies_keep_twelve_digits():
    assert significant(-1.67787364123456e7, 12) == "-16778736.4123"
    assert significant(-333734.443434567, 12) == "-333734.443435"


def test_the_summary_names_solvers_and_cases_that_miss_the_tolerance(
    measured, evidence
):
    records = [
        measured("osqp", 10),
        measured("osqp", 20, status=Verdict.INACCURATE, dual=4e-6),
        measured("osqp", 40, status=Verdict.TIME_LIMIT, claimed=None, dual=None),
        measured("good", 10),
        measured("good", 20, claimed="failed"),
        measured("shy", 10, status=Verdict.DECLINED, message="has rows"),
    ]
    found = evidence(records)
    assert sentences(found, "osqp") == [
        "osqp: claimed success but was inaccurate on 1 of 3 cases at tol 1e-8 (worst "
        "residual 4.0e-6; beam-ring/size=20/dual); reached the time limit on 1 of 3 "
        "cases at tol 1e-8 (beam-ring/size=40/dual)."
    ]
    assert sentences(found, "good") == [
        "good: verified on all 2 cases at tol 1e-8; worst residual 2.0e-9; 1 verified "
        "answer without a claim of success."
    ]
    assert sentences(found, "shy") == ["shy: declined 1 case: has rows."]
    counts = {row["solver"].text: row for row in table(compose(found), "summary")}
    assert counts["osqp"]["measurements"].value == 3
    assert [counts["osqp"][k].value for k in ("verified", "inaccurate", "limit")] == (
        [1, 1, 1]
    )
    assert counts["shy"]["declined"].value == 1


def test_each_tolerance_has_a_separate_sentence(measured, evidence):
    found = evidence([measured("a"), measured("a", tol=1e-4, status=Verdict.WRONG)])
    loose, tight = sentences(found, "a")
    assert "wrong on 1 of 1 case at tol 1e-4" in loose
    assert "verified on its only case at tol 1e-8" in tight


def test_measurements_of_two_machines_are_flagged(measured, evidence):
    page = compose(evidence([measured("a"), measured("b", environment="xyz")]))
    assert any("from 2 environments" in text for s in page.sections for text in s.prose)
    assert any("not compared" in text for text in page.sections[0].prose)


def test_energies_are_compared_across_solvers_and_forms(measured, evidence):
    def with_energy(solver, form, energy, **changes):
        return measured(solver, form=form, quantities={"energy": energy}, **changes)

    found = evidence(
        [
            with_energy("a", "dual", -100.0),
            with_energy("a", "primal", -100.0 - 3e-5),
            with_energy("b", "dual", -100.0 + 1e-5),
            with_energy("c", "dual", -90.0, status=Verdict.WRONG),
            with_energy("d", "dual", -90.0, tol=1e-2),
        ]
    )
    loose, tight = sorted(spreads(found.flat), key=lambda s: -s.answers[0].tol)
    assert tight.relative == pytest.approx(4e-7, rel=1e-5)
    assert {(o.solver, o.first.form) for o in tight.pair} == {
        ("a", "primal"), ("b", "dual"),
    }  # fmt: skip
    assert loose.relative is None  # a single answer has no difference, not zero


def test_the_difference_of_energies_is_relative_to_the_larger(measured, evidence):
    energies = {"a": -100.0, "b": -75.0}
    records = [measured(s, quantities={"energy": e}) for s, e in energies.items()]
    (spread,) = spreads(evidence(records).flat)
    assert spread.relative == 0.25


def test_repeats_of_one_answer_are_not_compared_as_energies(measured, evidence):
    (spread,) = spreads(evidence([measured("a", repeat=i) for i in range(3)]).flat)
    assert len(spread.answers) == 1
    assert spread.relative is None


def grown(measured, solver, power, **changes):
    return [
        measured(solver, size, total_seconds=1e-5 * (2 * size) ** power, **changes)
        for size in (10, 30, 100, 300)
    ]


def test_a_planted_exponent_is_found_from_the_records(measured, evidence):
    records = [*grown(measured, "a", 1.5), *grown(measured, "b", 1.0)]
    liar = measured("a", 900, total_seconds=1e-9, status=Verdict.WRONG)
    (series,) = size_series(evidence([*records, liar]))
    assert series.time_law("a").exponent == pytest.approx(1.5)
    assert series.time_law("b").exponent == pytest.approx(1.0)
    assert series.iteration_law("a").exponent == pytest.approx(0.0)
    rows = table(compose(evidence(records)), "scaling")
    assert [(r["n"].text, r["m"].text) for r in rows[:2]] == [
        ("20", "14"),
        ("60", "34"),
    ]
    against_n, against_m = rows[-2:]
    assert against_n["n"].text == "p against n [95 %]"
    assert against_n["a"].text == "1.50 [1.50, 1.50]"
    assert against_m["n"].text == "p against m [95 %]"
    law = power_law([14, 34, 104, 304], [(2 * n) ** 1.5 for n in (10, 30, 100, 300)])
    assert against_m["a"].text == exponent(law)
    assert "****" not in markdown(compose(evidence(records)))


def test_load_steps_are_separate_series(measured, evidence):
    def on_step(size, step):
        return measured(
            "a", size, params={"size": size, "step": step}, run_id=f"{size}-{step}",
            case=f"beam-ring/size={size}/step={step}/dual",
        )  # fmt: skip

    records = [on_step(size, step) for size in (10, 20, 40) for step in (1, 5)]
    found = size_series(evidence(records))
    assert [series.title for series in found] == [
        "beam-ring/step=1/dual, tol 1e-8",
        "beam-ring/step=5/dual, tol 1e-8",
    ]
    assert [len(series.curve("a")) for series in found] == [3, 3]


def test_two_sizes_have_no_scaling_table(measured, evidence):
    page = compose(evidence([measured("a", 10), measured("a", 20)]))
    assert "scaling" not in [s.name for s in page.sections]


def test_cases_are_sorted_numerically(measured, evidence):
    found = evidence([measured("a", size) for size in (100, 9, 20)])
    assert [o.first.params["size"] for o in found.flat] == [9, 20, 100]


def test_solvers_are_in_the_order_of_the_suite(measured, evidence):
    suite = {"solvers": ["z", {"name": "clarabel", "label": "c"}, "absent"]}
    found = evidence([measured(s) for s in ("c", "a", "z")], suite=suite)
    assert found.solvers == ("z", "c", "a")


class Page(HTMLParser):
    """Parser that collects all scripts and links of a page."""

    def __init__(self):
        super().__init__()
        self.tags, self.links, self.handlers, self.kinds = [], [], [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        if tag == "script":
            self.kinds.append(dict(attrs).get("type"))
        for name, value in attrs:
            if name.startswith("on"):
                self.handlers.append((tag, name))
            if name in {"src", "href", "xlink:href"}:
                self.links.append(value)


@pytest.fixture(scope="module")
def hostile(measured):
    def record(text, size):
        return measured(
            text, size, case=f"{text}/dual", family=text, message=text, claimed=text,
            params={text[:50]: text}, options={text[:50]: text}, counts={text[:50]: 3},
            run_id=f"{text}{size}", started=text,
            quantities={"dofs": size, text[:50]: text},
        )  # fmt: skip

    return [record(t, size) for t in HOSTILE for size in (10, 20, 40)] + [
        measured(t, size) for t in HOSTILE for size in (10, 20, 40)
    ]


@pytest.fixture(scope="module")
def hostile_folder(hostile, tmp_path_factory, svg_only):
    folder = write(tmp_path_factory.mktemp("hostile") / "run", hostile)
    (folder / "environment.json").write_text(
        '{"machine": {"cpu": "<b>$x_1$ & co</b>"}, "list": [{"</style>": null}]}'
    )
    with svg_only():
        write_report(folder, ["html", "md", "tex"])
    return folder / "report"


def test_hostile_names_do_not_add_elements_to_the_page(hostile_folder):
    text = (hostile_folder / "index.html").read_text("utf-8")
    page = Page()
    page.feed(text)
    assert page.kinds == ["application/json", "application/gzip", None]  # our scripts
    assert page.tags.count("style") == 1
    assert not {"img", "meta"} & set(page.tags[page.tags.index("body") :])
    assert page.handlers == []
    assert all(link.startswith(("#", "data:", "figures/")) for link in page.links)
    assert "&lt;script&gt;" in text
    assert "\u202e" not in text
    assert "long" * 600 not in text  # abbreviated, also in hover texts


def test_names_break_at_slashes_and_numbers_do_not_break():
    assert breakable("<a>/b at 1e-8") == (
        '&lt;a&gt;/<wbr>b at <span class="nb">1e-8</span>'
    )


def test_the_page_fetches_nothing(hostile_folder):
    text = (hostile_folder / "index.html").read_text("utf-8")
    styles = re.findall(r"<style.*?</style>", text, flags=re.DOTALL)
    assert not any("url(" in s or "@import" in s for s in styles)


def test_hostile_names_do_not_break_latex(hostile_folder):
    for path in (hostile_folder / "tables").glob("*.tex"):
        for line in path.read_text("utf-8").splitlines()[1:]:
            bare = re.sub(r"\\[\\{}$&#%_]", "", line)
            assert bare.count("{") == bare.count("}"), line
            assert bare.count("$") % 2 == 0, line
            assert not re.search(r"[#%]|\\input", bare), line
            assert all(ord(c) < 256 for c in bare), line


def test_latex_rows_have_as_many_columns_as_the_table(measured, evidence):
    page = compose(evidence([*grown(measured, "a", 1), *grown(measured, "b & c", 1)]))
    (scaling,) = (s for s in page.sections if s.name == "scaling")
    text = latex(scaling.tables)
    assert text.count(r"\toprule") == len(scaling.tables) == 2
    assert r"\begin{tabular}{rrrr}" in text
    rows = [line for line in text.splitlines() if line.endswith(r"\\")]
    assert {len(re.split(r"(?<!\\)&", row)) for row in rows} == {4}


def test_latex_escapes_special_characters():
    assert escaped(r"\a_{b}^2 50% $ # & ~") == (
        r"\textbackslash{}a\_\{b\}\textasciicircum{}2 50\% \$ \# \& \textasciitilde{}"
    )
    assert escaped("[1]") == "{}[1]"  # after \\, "[1]" would be an optional argument
    assert escaped("漢") == "U+6F22"


def test_hostile_names_do_not_break_markdown_tables(hostile_folder):
    text = (hostile_folder / "report.md").read_text("utf-8")
    columns = None
    for line in text.splitlines():
        if not line.startswith("|"):
            columns = None
            continue
        count = len(re.findall(r"(?<!\\)\|", line))
        assert columns in (None, count), line
        columns = count
    assert not re.search(r"<\w", text)
    assert len(re.findall(r"^## ", text, flags=re.MULTILINE)) == text.count("\n## ")
    assert "\n## heading" not in text


def test_markdown_shows_entities_and_markup_as_they_are():
    assert md_escaped("&lt; *a* |") == r"&amp;lt; \*a\* \|"


def test_names_are_abbreviated_in_the_middle_and_stay_distinct():
    assert clean("a\x00b\n c") == "a\ufffdb c"
    one, other = clean("x" * 10_000 + "1"), clean("x" * 10_000 + "2")
    assert len(one) == 96
    assert one != other


@pytest.fixture
def square():
    return Fields(
        points=np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=float),
        cells=np.array([[0, 1, 2, 3]]), bodies=np.array([0]),
        displacement=np.zeros((4, 2)), nodal={"von_mises": np.arange(4) * 1e9},
    )  # fmt: skip


@pytest.mark.parametrize(
    "figures", ["blank_figures", pytest.param("only_svg", marks=pytest.mark.slow)]
)
def test_the_same_journal_gives_the_same_bytes(
    request, measured, square, tmp_path, figures
):
    request.getfixturevalue(figures)
    folders = []
    for name in ("one", "two"):
        folder = tmp_path / name
        digest = save_fields(folder, square)
        records = [*grown(measured, "a", 1.5), measured("b", 300, fields=digest)]
        folders.append(write(folder, records))
        (folder / "suite.toml").write_text('name = "demo"\n')
    first, second = (write_report(f, ["html", "md", "tex", "csv"]) for f in folders)
    names = [path.relative_to(folders[0] / "report").as_posix() for path in first]
    assert {"index.html", "report.md", "tables/scaling.tex", "tables/outcomes.csv",
            "figures/deformed.svg", "figures/scaling-1.svg"} <= set(names)  # fmt: skip
    for a, b in zip(first, second, strict=True):
        assert a.read_bytes() == b.read_bytes(), a.name


def test_a_report_removes_obsolete_numbered_figures(tmp_path):
    figures = tmp_path / "figures"
    figures.mkdir()
    for name in ("profiles-2.pdf", "deformed.png", "profiles-2.txt", "my-2 notes.pdf"):
        (figures / name).touch()

    write_figures(layout.Page(title="", dateline="", sections=()), tmp_path)

    left = {path.name for path in figures.iterdir()}
    assert left == {"deformed.png", "profiles-2.txt", "my-2 notes.pdf"}


def test_the_largest_verified_case_is_drawn(measured, square, tmp_path):
    digest = save_fields(tmp_path, square)
    records = [
        measured("a", 10, fields=digest),
        measured("a", 30, fields=digest),
        measured("a", 90, fields=digest, status=Verdict.INACCURATE),
    ]
    page = compose(Evidence(directory=tmp_path, records=arrange(records)))
    (picture,) = (p for s in page.sections if s.name == "deformed" for p in s.pictures)
    assert picture.caption.startswith("beam-ring/size=30/dual")
    assert "2.98 GPa" in picture.caption  # 99.5 % quantile of 0, 1, 2, 3
    assert "factor 1" in picture.caption


def test_the_largest_cases_in_2d_and_3d_are_drawn(measured, square, tmp_path):
    cube = box((0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (1, 1, 1))
    solid = Fields(
        points=cube.points, cells=cube.cells, displacement=0 * cube.points,
        bodies=np.zeros(1, dtype=int),
    )  # fmt: skip
    plane, space = save_fields(tmp_path, square), save_fields(tmp_path, solid)
    records = [
        measured("a", 10, fields=space, family="cube-wall"),
        measured("a", 30, fields=plane),
        measured("a", 20, fields=plane, family="hertz-plane"),
        measured("a", 5, fields=space, family="hertz-sphere"),
    ]
    page = compose(Evidence(directory=tmp_path, records=arrange(records)))
    pictures = [p for s in page.sections if s.name == "deformed" for p in s.pictures]

    assert [p.name for p in pictures] == ["deformed", "deformed-in-space"]
    assert "the largest verified plane case" in pictures[0].caption
    assert "the largest verified three-dimensional case" in pictures[1].caption
    assert [len(p.figure.panels) for p in pictures] == [1, 1]


def test_csv_contains_full_precision_and_intervals_of_times(measured, tmp_path):
    times = [0.1 + 0.2, 0.7, 0.1]
    write(tmp_path, timed(measured, "a", times))
    paths = write_report(tmp_path, ["csv"])
    assert {p.parent.name for p in paths} == {"tables"}
    with (tmp_path / "report/tables/outcomes.csv").open(newline="") as file:
        (row,) = csv.DictReader(file)
    parts = [float(row[f"total_seconds_{k}"]) for k in ("median", "low", "high")]
    assert parts == [times[0], 0.1, 0.7]
    assert float(row["interval_coverage"]) == 0.75
    assert (row["n"], row["m"], row["iterations_min"]) == ("20", "14", "7")
    assert float(row["energy"]) == -12345.678901234


@pytest.mark.usefixtures("blank_figures")
def test_only_the_requested_formats_are_written(measured, tmp_path):
    write(tmp_path, [measured("a")])
    write_report(tmp_path, ["md"])
    written = {p.name for p in (tmp_path / "report").iterdir()}
    assert written == {"report.md", "figures"}


def test_bad_input_causes_a_one_line_message_with_the_expected_value(
    tmp_path, measured
):
    with pytest.raises(InputError, match="'htm'; did you mean 'html'") as unknown:
        write_report(tmp_path, ["htm"])
    with pytest.raises(InputError, match="no such folder") as missing:
        write_report(tmp_path / "none", ["html"])
    write(tmp_path / "empty", [])
    with pytest.raises(InputError, match="no measurement") as empty:
        write_report(tmp_path / "empty", ["html"])
    folder = write(tmp_path / "bad", [measured("a")])
    (folder / "suite.toml").write_text("name = ")
    with pytest.raises(InputError, match=r"suite\.toml") as malformed:
        write_report(folder, ["html"])
    (folder / "suite.toml").unlink()
    for damaged in (b"{", b"[]", b"\xff"):
        (folder / "environment.json").write_bytes(damaged)
        with pytest.raises(InputError, match=r"environment\.json: .*; expected"):
            write_report(folder, ["html"])
    for error in (unknown, missing, empty, malformed):
        assert "\n" not in str(error.value)
