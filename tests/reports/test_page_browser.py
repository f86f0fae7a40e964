"""The page in a browser: offline, by mouse and keyboard, on phones, in dark mode.

All tests share one Chromium, and most of them share one page of a small campaign.
"""

import os
import shutil

import numpy as np
import pytest

from mortarbench.harness import Record, Verdict
from mortarbench.harness.results.journal import Journal
from mortarbench.reports.compare.changes import compare
from mortarbench.reports.compare.page import compose as comparison
from mortarbench.reports.data.evidence import read_evidence
from mortarbench.reports.document.fields import FieldFigure, FieldPanel, Polygons
from mortarbench.reports.document.layout import Page, Picture, Section
from mortarbench.reports.folder import compose
from mortarbench.reports.render.html_page import html
from tests.support.synthetic_results import records as synthetic
from tests.support.synthetic_results import write

pytestmark = pytest.mark.together  # one browser, long pages

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
SOLVERS, CASES, REPEATS = 4, 40, 3
#: Browsers do not lay out figures off the screen, and such figures have no inner text.
ALL_LAID_OUT = "figure { content-visibility: visible !important }"
HOSTILE = (
    '<script>window.broken=1</script>"><img src=http://evil.example/x onerror=a()>',
    "</script><script>window.broken=1</script><!-- ]]> \u2028 \u2029",
    r"\input{/etc/passwd}$^$_#&%~{} `code` | a | **b** [l](http://evil.example)",
    "\u202eright-to-left \u0645\u0631\u062d\u0628\u0627 e\u0301\u0301 \u200b\u200d 🙂",
    "__proto__",
    "x" * 10_000,
)


@pytest.fixture(scope="session")
def browser():
    try:
        from playwright import sync_api
    except ModuleNotFoundError:
        pytest.fail("no playwright; make browser installs it")
    if CHROMIUM is None:
        pytest.fail("no chromium; make browser installs it")
    root = ["--no-sandbox"] if os.geteuid() == 0 else []
    # otherwise the address bar of each window loads two more pages
    bar = "--disable-features=WebUIOmniboxPopup,WebUIOmniboxAimPopup"
    with sync_api.sync_playwright() as playwright:
        chromium = playwright.chromium.launch(
            executable_path=CHROMIUM, args=[*root, bar]
        )
        yield chromium
        chromium.close()


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("it's a run")
    return paged(write(path, SOLVERS, CASES, REPEATS))


def paged(folder):
    """Write the page of a result folder, without its printed figures."""
    (folder / "report").mkdir()
    text = html(compose(read_evidence(folder)))
    (folder / "report" / "index.html").write_text(text, "utf-8", newline="\n")
    return folder


@pytest.fixture(scope="session")
def records():
    return list(synthetic(SOLVERS, CASES, REPEATS))


@pytest.fixture(scope="session")
def tabs(browser):
    """Return a factory of tabs, one per set of options.

    Tabs are reused, because a page opens in half the time in an existing tab.
    """
    tabs, said, asked = {}, [], []

    def tab(**options):
        key = frozenset(options.items())
        if key not in tabs:
            page = tabs[key] = browser.new_context(**options).new_page()
            page.set_default_timeout(60_000)
            page.on("console", lambda message: said.append(message.text))
            page.on("pageerror", lambda error: said.append(str(error)))
            page.on("request", lambda request: asked.append(request.url))
        return tabs[key]

    yield tab, said, asked
    for page in tabs.values():
        page.context.close()


@pytest.fixture
def visit(tabs):
    """Open a page; at the end, assert no messages and no requests except for pages.

    The factory lays out all figures, which takes half of the time, unless `whole` is
    False.
    """
    tab, said, asked = tabs
    said.clear()
    asked.clear()
    visits = []

    def open_(path, fragment="", width=1400, *, folded=False, whole=True, **options):
        page = tab(**options)
        scripts = options.get("java_script_enabled", True)
        visits.append((page, scripts))
        page.goto("about:blank")  # a change of the fragment alone would not load a page
        page.set_viewport_size({"width": width, "height": 900})
        page.goto((path / "report" / "index.html").as_uri() + fragment)
        if scripts:
            if whole:
                page.add_style_tag(content=ALL_LAID_OUT)
            if not folded:
                page.evaluate("for (const one of [...document.querySelectorAll("
                              "'#tools')]) one.open = true")  # fmt: skip
        return page

    yield open_
    for page, scripts in visits:
        if scripts:
            page.evaluate("localStorage.clear()")
    assert said == []
    assert all(url.startswith("file:") for url in asked)
    assert len(asked) == len(visits)  # only requests of the pages themselves


def table(page, section, number=0):
    return page.locator(f"#{section} figure.table").nth(number)


def column(figure, head):
    """Return the texts of one column in the visible rows."""
    heads = figure.locator("thead th:visible").all_inner_texts()
    cells = figure.locator(f"tbody td:nth-child({heads.index(head) + 1})")
    return [text.strip() for text in cells.all_inner_texts()]


def names(records, **wanted):
    fits = (
        r for r in records if all(getattr(r, k) == v for k, v in wanted.items())
    )  # fmt: skip
    return list(dict.fromkeys(r.case for r in fits))


def opened(page):
    """Return the dialog after its measurements are unpacked."""
    dialog = page.get_by_role("dialog")
    dialog.wait_for()
    return dialog


def toggle(page, solver):
    page.locator("#solvers button", has_text=solver).click()


FIRST_SCREENS = [
    (1400, 900, "light"),
    (390, 844, "dark"),
    pytest.param(1400, 900, "dark", marks=pytest.mark.slow),
    pytest.param(390, 844, "light", marks=pytest.mark.slow),
]
WIDE_LATER = [pytest.param(1400, marks=pytest.mark.slow), 390]


@pytest.mark.parametrize(("width", "height", "scheme"), FIRST_SCREENS)
def test_the_first_screen_shows_the_first_sentence_and_the_first_figure(
    visit, folder, width, height, scheme
):
    page = visit(folder, width=width, folded=True, color_scheme=scheme, whole=False)
    page.set_viewport_size({"width": width, "height": height})
    claim = page.locator("main .claim").first
    plot = page.locator("main .plot").first
    assert claim.inner_text().startswith("From the mesh to a verified answer")
    for shown in (claim, plot, plot.locator("svg").first):
        box = shown.bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= width
        assert 0 <= box["y"] < box["y"] + box["height"] <= height
    assert page.evaluate("scrollY") == 0
    subjects = page.locator("#forms .answer:not(.besides) dt").all_inner_texts()
    assert subjects == ["dual", "primal"]


@pytest.mark.parametrize("width", WIDE_LATER)
def test_navigation_and_filters_are_folded_until_opened(visit, folder, width):
    page = visit(folder, width=width, folded=True, whole=False)
    link = page.get_by_role("link", name="Summary", exact=True).first
    for summary, inside in (("Contents", link), ("Filter", page.locator("#words"))):
        assert inside.is_hidden()
        page.locator("summary", has_text=summary).first.click()
        assert inside.is_visible()
    link.click()
    assert page.url.endswith("#summary")


@pytest.mark.parametrize("width", WIDE_LATER)
def test_no_text_of_the_first_figure_leaves_its_drawing(visit, folder, width):
    drawing = (
        visit(folder, width=width, whole=False).locator("#answer .panel > svg").first
    )
    drawing.scroll_into_view_if_needed()
    edges = drawing.bounding_box()
    for text in drawing.locator("> text").all():
        box = text.bounding_box()
        assert box["x"] >= edges["x"] - 1
        assert box["x"] + box["width"] <= edges["x"] + edges["width"] + 1


def test_evidence_links_work_by_keyboard(visit, folder):
    page = visit(folder, reduced_motion="reduce")
    link = page.locator("#forms dd a", has_text="Means over cases").first
    link.focus()
    page.keyboard.press("Enter")
    page.wait_for_url("**#means")
    top = "document.querySelector('#means h2').getBoundingClientRect().top"
    page.wait_for_function(f"0 <= {top} && {top} < innerHeight")


def test_on_a_phone_the_answer_is_no_wider_than_the_screen(visit, folder):
    page = visit(folder, width=390, whole=False)
    for text in page.locator("#answer dt, #answer dd p").all():
        box = text.bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= 390


def test_a_table_of_many_rows_shows_the_first_and_pages_through_all(
    visit, folder, records
):
    errors = table(visit(folder), "errors")
    outcomes = len(records) // REPEATS
    assert errors.locator("tbody tr").count() == 50
    assert f"Rows 1–50 of {outcomes} rows" in errors.inner_text()
    errors.get_by_role("button", name="next rows").click()
    assert f"Rows 51–100 of {outcomes} rows" in errors.inner_text()
    errors.get_by_role("button", name="all rows").click()
    assert errors.locator("tbody tr").count() == outcomes


def test_a_filter_shows_exactly_the_matching_rows(visit, folder, records):
    page = visit(folder)
    times = table(page, "times")
    times.locator("input").fill("Nr=6/ mortar dual")
    wanted = [
        c for c in names(records) if "Nr=6/" in c and "mortar" in c and "dual" in c
    ]
    assert len(wanted) == 5
    assert sorted(column(times, "case")) == sorted(wanted)
    times.locator("input").fill("")
    page.fill("#words", "step=3 nts primal")
    wanted = {c for c in names(records) if "step=3/contact=nts/primal" in c}
    for section in ("cases", "times", "iterations", "errors"):
        assert set(column(table(page, section), "case")) == wanted, section
    points = page.evaluate("document.querySelector('.plot svg .trace') !== null")
    assert points


def test_the_verdict_filter_shows_exactly_the_matching_cases(visit, folder, records):
    page = visit(folder)
    page.select_option("#verdict", "inaccurate")
    wanted = set(names(records, status=Verdict.INACCURATE))
    assert 0 < len(wanted) < 50
    assert set(column(table(page, "verdicts"), "case")) == wanted
    assert set(column(table(page, "cases"), "case")) == wanted
    errors = table(page, "errors")
    found = zip(column(errors, "case"), column(errors, "solver"), strict=True)
    assert set(found) == {
        (r.case, r.solver) for r in records if r.status is Verdict.INACCURATE
    }
    toggle(page, "solver-a")  # rows with inaccurate answers of a are hidden
    wanted = {
        r.case
        for r in records
        if r.status is Verdict.INACCURATE and r.solver != "solver-a"
    }  # fmt: skip
    assert set(column(table(page, "verdicts"), "case")) == wanted


def test_a_click_on_a_heading_sorts_and_a_second_click_reverses(visit, folder, records):
    errors = table(visit(folder), "errors")
    head = errors.get_by_role("button", name="dual", exact=True)
    head.click()
    ascending = sorted({r.dual for r in records})
    assert head.locator("..").get_attribute("aria-sort") == "ascending"
    assert float(column(errors, "dual")[0]) == pytest.approx(ascending[0], rel=0.06)
    shown = [float(text) for text in column(errors, "dual")]
    assert shown == sorted(shown)
    head.click()
    assert head.locator("..").get_attribute("aria-sort") == "descending"
    assert float(column(errors, "dual")[0]) == pytest.approx(ascending[-1], rel=0.06)


def test_hiding_a_solver_hides_it_everywhere(visit, folder):
    page = visit(folder)
    solver = page.locator("#solvers button", has_text="solver-b")

    def traces():
        return page.locator(".plot svg [data-solver='1']").count()

    def columns():
        heads = table(page, "times").locator("thead th:visible")
        return [h.strip() for h in heads.all_inner_texts()]

    assert traces() > 5
    assert solver.get_attribute("aria-pressed") == "true"
    solver.click()
    assert solver.get_attribute("aria-pressed") == "false"
    assert traces() == 0
    assert page.locator(".plot svg [data-solver='0']").count() > 5
    assert columns() == ["case", "tol", "solver-a", "solver-c", "solver-d"]
    assert "solver-b" not in column(table(page, "errors"), "solver")
    assert page.get_by_text("Counts of solver-b").is_hidden()
    assert page.locator(".legend [aria-pressed=false]").count() > 1
    page.locator(".legend button", has_text="solver-b").first.click()
    assert traces() > 5
    assert columns()[3] == "solver-b"


def test_redrawn_tables_equal_the_written_ones(visit, folder):
    page = visit(folder)
    bodies = "[...document.querySelectorAll('tbody')].map((b) => b.innerHTML.trim())"
    clean = r".replace(/ tabindex=.-?\d.|\n/g, '')"
    written = page.evaluate(f"{bodies}.map((t) => t{clean})")
    page.evaluate("hidden.add(0); redraw(); hidden.clear(); redraw()")
    assert page.evaluate(f"{bodies}.map((t) => t{clean})") == written


@pytest.mark.slow
def test_a_redrawn_hostile_table_equals_the_written_one(visit, hostile):
    page = visit(hostile)
    rows = "[...document.querySelectorAll('tbody tr')].map((r) => r.innerText.trim())"
    written = page.evaluate(rows)
    page.evaluate("hidden.add(0); redraw(); hidden.clear(); redraw()")
    assert page.evaluate(rows) == written
    assert page.locator("bdi").count() > 3  # right-to-left text


@pytest.mark.parametrize(
    ("scheme", "paper"),
    [pytest.param("light", 255, marks=pytest.mark.slow), ("dark", 21)],
)
def test_colours_follow_the_system_until_a_theme_is_chosen(
    visit, folder, scheme, paper
):
    page = visit(folder, color_scheme=scheme, whole=False)

    def red():
        colour = page.evaluate("getComputedStyle(document.body).backgroundColor")
        return int(colour.removeprefix("rgb(").split(",")[0])

    assert red() == paper
    button = page.get_by_role("button", name="colours")
    button.click()
    assert (button.inner_text(), red()) == ("colours: light", 255)
    button.click()
    assert (button.inner_text(), red()) == ("colours: dark", 21)
    button.click()
    assert (button.inner_text(), red()) == ("colours: system", paper)


def test_the_tab_key_reaches_all_controls(visit, folder):
    page = visit(folder)
    reached = page.evaluate(
        """() => {
          const able = "a[href], button, input, select, summary, [tabindex]";
          return [...document.querySelectorAll(able)]
            .filter((e) => e.checkVisibility() && !e.disabled && e.tabIndex < 0)
            .filter((e) => !e.closest("td"))  // arrow keys reach these
            .map((e) => e.outerHTML.slice(0, 99));
        }"""
    )
    assert reached == []
    page.locator("#solvers button").first.focus()
    seen = []
    for _ in range(9):
        seen.append(page.evaluate("document.activeElement.innerText || "
                                  "document.activeElement.id"))  # fmt: skip
        page.keyboard.press("Tab")
    expected = ["solver-a", "solver-b", "solver-c", "solver-d", "all", "none"]
    assert [s.strip() for s in seen[:7]] == [*expected, "words"]


def test_keys_toggle_solvers_sort_tables_and_walk_through_numbers(visit, folder):
    page = visit(folder, whole=False)
    solver = page.locator("#solvers button").first
    for key, pressed in (("Enter", "false"), ("Space", "true")):
        solver.press(key)
        assert solver.get_attribute("aria-pressed") == pressed
    times = table(page, "times")
    head = times.get_by_role("button", name="solver-c")
    head.press("Enter")
    assert head.locator("..").get_attribute("aria-sort") == "ascending"
    links = times.locator("tbody a")
    first = times.locator("tbody tr").nth(0).locator("a")
    first.nth(0).focus()
    page.keyboard.press("ArrowRight")
    assert first.nth(1).evaluate("(a) => a === document.activeElement")
    page.keyboard.press("ArrowDown")
    below = times.locator("tbody tr").nth(1).locator("a").nth(1)
    assert below.evaluate("(a) => a === document.activeElement")
    assert (
        links.evaluate_all("(all) => all.filter((a) => a.tabIndex === 0).length") == 1
    )
    page.keyboard.press("Enter")
    opened(page)
    page.keyboard.press("Escape")
    assert page.get_by_role("dialog").is_hidden()
    assert below.evaluate("(a) => a === document.activeElement")


def test_a_number_links_to_its_journal_line(visit, folder, records):
    page = visit(folder)
    wanted = records[0]
    times = table(page, "times")
    link = times.locator(f"a[href='#run-{wanted.run_id}']")
    fastest = min(r.total_seconds for r in records[:REPEATS])
    assert f"µs [{1e6 * fastest:.0f}, " in link.inner_text()
    link.click()
    dialog = opened(page)
    assert page.url.endswith(f"#run-{wanted.run_id}")
    dialog.get_by_text("other fields of the journal line").click()
    fields = dict(zip(dialog.locator("th").all_inner_texts(),
                      dialog.locator("td").all_inner_texts(), strict=True))  # fmt: skip
    line = page.evaluate("(line) => JSON.parse(line)", wanted.to_json())
    # fields with their defaults, which journal lines of older versions lack
    line |= {"session": "", "ranks": 1}
    told = page.evaluate("(id) => line(runs.id.indexOf(id))", wanted.run_id)
    assert told == line
    assert fields.keys() == line.keys()
    assert float(fields["total_seconds"]) == wanted.total_seconds
    quoted = str(folder).replace("'", "'\\''")
    assert f"mortarbench replay '{quoted}' {wanted.run_id}" in dialog.inner_text()
    vectors = dialog.get_by_role("link", name="vectors/")
    assert vectors.get_attribute("href") == f"../vectors/{wanted.vectors}.npz"
    assert "1 of 3" in dialog.inner_text()
    dialog.get_by_role("button", name="›").click()
    dialog.get_by_role("heading", name=f"Run {records[1].run_id}").wait_for()


def test_every_run_link_has_a_target(visit, folder, records):
    page = visit(folder, whole=False)
    links = page.evaluate(
        "[...document.querySelectorAll('a[href^=\"#run-\"]')].map((a) => a.hash)"
    )
    assert len(links) > 500
    assert set(links) <= {f"#run-{r.run_id}" for r in records}
    one = visit(folder, fragment=f"#run-{records[7].run_id}", whole=False)
    assert f"Run {records[7].run_id}" in opened(one).inner_text()


def test_a_plot_zooms_changes_its_axes_and_names_the_point_under_the_pointer(
    visit, folder, records
):
    page = visit(folder, whole=False)
    plot = page.locator("#times .panel")
    drawing = plot.locator("svg").first
    drawing.scroll_into_view_if_needed()

    def ticks():
        return plot.locator("svg > text").all_text_contents()

    before = ticks()
    plot.get_by_role("button", name="zoom in").click()
    assert ticks() != before
    plot.get_by_role("button", name="whole plot").click()
    assert ticks() == before
    log = plot.get_by_role("button", name="logarithmic horizontal axis")
    assert log.get_attribute("aria-pressed") == "true"
    log.click()
    assert log.get_attribute("aria-pressed") == "false"
    linear = [float(t) for t in ticks() if t.replace(".", "").isdigit()]
    assert ticks() != before
    assert len(linear) > 4
    log.click()
    drawing.focus()
    page.keyboard.press("ArrowRight")
    tip = plot.locator(".tip").inner_text()
    run = next(r for r in records if r.run_id in tip)
    assert run.solver in tip
    assert run.case in tip
    page.keyboard.press("Enter")
    assert f"Run {run.run_id}" in opened(page).inner_text()


@pytest.fixture(scope="session")
def compared(tmp_path_factory):
    """Return a page that compares two runs, with names of different lengths."""
    paths = [tmp_path_factory.mktemp(name) for name in ("before", "after")]
    for path in paths:
        with Journal(path, "test") as journal:
            for i, solver in enumerate(("osqp-polish", "x" * 30, "short")):
                for repeat in range(3):
                    journal.append(Record(
                        run_id=f"{i}-{repeat}", case="box/n=1/dual", family="box",
                        params={"n": 1}, form="dual", sizes={"variables": 10},
                        solver=solver, options={}, tol=1e-6, repeat=repeat,
                        block=repeat, status=Verdict.VERIFIED, claimed="solved",
                        iterations=7, total_seconds=1e-3 * (1 + 0.01 * repeat * i),
                        primal=1e-9, dual=1e-9, complementarity=1e-9, gap=1e-9,
                        started="2026-11-21T10:00:00+00:00",
                    ))  # fmt: skip
    (paths[1] / "report").mkdir()
    page = html(comparison(compare(*map(read_evidence, paths))))
    (paths[1] / "report" / "index.html").write_text(page, "utf-8", newline="\n")
    return paths[1]


@pytest.mark.parametrize("width", [1400, 390])
def test_names_beside_a_plot_are_not_clipped(visit, compared, width):
    drawing = visit(compared, width=width).locator("#times .panel > svg").first
    drawing.scroll_into_view_if_needed()
    edge = drawing.bounding_box()["x"]
    names = drawing.locator("> text[text-anchor=end]")
    shown = [name.evaluate("e => e.firstChild.data") for name in names.all()]

    assert len(shown) == 3
    assert {"osqp-polish", "short"} <= set(shown)
    assert all(name.bounding_box()["x"] >= edge for name in names.all())
    assert names.locator("title").all_text_contents() == (
        ["x" * 30] if width == 390 else []
    )


@pytest.mark.parametrize(
    ("view", "texts"),
    [([4e-4, 3e-3], ["5·10⁻⁴", "10⁻³", "2·10⁻³"]),
     ([5e-5, 2], ["10⁻⁴", "10⁻³", "10⁻²", "10⁻¹", "10⁰"]),
     ([0.05, 2], ["0.05", "0.1", "0.2", "0.5", "1", "2"])],
)  # fmt: skip
def test_the_ticks_of_an_axis_have_one_format(visit, folder, view, texts):
    axis = {"view": view, "log": True}
    found = visit(folder, whole=False).evaluate("axis => labelled(axis, 8)", axis)

    assert [text for _, text in found] == texts


def test_dragging_over_a_plot_zooms_into_the_rectangle(visit, folder):
    page = visit(folder, whole=False)
    drawing = page.locator("#times .panel svg").first
    drawing.scroll_into_view_if_needed()
    box = drawing.bounding_box()
    path = drawing.locator(".trace").first
    whole = path.get_attribute("d").count("M")
    page.mouse.move(box["x"] + 0.5 * box["width"], box["y"] + 0.3 * box["height"])
    page.mouse.down()
    page.mouse.move(box["x"] + 0.7 * box["width"], box["y"] + 0.6 * box["height"])
    page.mouse.up()
    assert 0 < path.get_attribute("d").count("M") < whole


def test_a_phone_shows_the_page_without_scrolling_sideways(visit, folder):
    page = visit(folder, width=390, has_touch=True)
    page.locator("#tools summary").click()
    outside = page.evaluate(
        """[...document.querySelectorAll("main *, #tools *, nav *")].filter((e) =>
          !e.closest(".scroll, svg, [role=img]") && e.checkVisibility()
          && e.getBoundingClientRect().right > innerWidth + 1)
          .map((e) => e.outerHTML.slice(0, 99))"""
    )
    assert outside == []
    assert page.evaluate("document.documentElement.scrollWidth") == 390


@pytest.mark.parametrize(("width", "wider"), [(1400, False), (390, True)])
def test_a_figure_wider_than_the_screen_has_a_scroll_hint(
    visit, tmp_path, width, wider
):
    cell = np.array([(0.0, 0.0), (2.0, 0.0), (2.0, 1.0), (0.0, 1.0)])
    panel = FieldPanel(low=(0, 0), high=(2, 1), marks=(Polygons(corners=(cell,)),))
    figure = FieldFigure(panels=(panel,), height=2)
    picture = Picture(name="still", caption="A cell.", figure=figure)
    section = Section(name="still", title="A still", pictures=(picture,))
    (tmp_path / "report").mkdir()
    text = html(Page(title="One figure", dateline="", sections=(section,)))
    (tmp_path / "report" / "index.html").write_text(text, "utf-8", newline="\n")
    page = visit(tmp_path, width=width)
    box = page.locator("#still .scroll")
    page.wait_for_function("document.querySelector('#still .scroll').clientWidth > 0")

    assert box.evaluate("e => e.scrollWidth > e.clientWidth + 1") == wider
    assert page.locator("#still .hint").is_visible() == wider
    assert page.evaluate("document.documentElement.scrollWidth") == width


def test_without_scripts_the_page_still_shows_figures_and_first_rows(visit, folder):
    page = visit(folder, java_script_enabled=False)
    assert page.locator("#times figure.drawing svg").count() == 1
    assert table(page, "errors").locator("tbody tr").count() == 50
    assert (
        f"The first 50 of {SOLVERS * CASES} rows"
        in table(page, "errors").text_content()
    )
    assert page.locator("#tools").is_hidden()


@pytest.fixture(scope="session")
def hostile(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hostile")
    with Journal(folder, "test") as journal:
        for i, text in enumerate(HOSTILE):
            for size in (10, 20, 40):
                journal.append(Record(
                    run_id=f"{text[:30]}{size}", case=f"{text}/n={size}/dual",
                    family=text, params={text: size}, form="dual", solver=text,
                    sizes={"variables": size}, options={text: text}, tol=1e-6,
                    repeat=0, block=0, claimed=text, message=text,
                    status=Verdict.WRONG if i % 2 else Verdict.VERIFIED,
                    iterations=size, counts={text: 3}, total_seconds=1e-3 * size,
                    primal=1e-9, dual=1e-9, complementarity=1e-9, gap=1e-9,
                    quantities={"dofs": size, text: text}, environment=text,
                    started=text, vectors=text[:20],
                ))  # fmt: skip
    (folder / "suite.toml").write_text("name = '''</title><h1>x'''\n")
    return paged(folder)


def test_hostile_names_are_inserted_as_text_by_the_script(visit, hostile):
    page = visit(hostile)
    kinds = "[...new Set([...document.querySelectorAll('*')].map((e) => e.localName))]"
    before = set(page.evaluate(kinds))
    page.evaluate("hidden.add(0); redraw(); hidden.clear(); redraw()")
    for i in range(3 * len(HOSTILE)):
        page.evaluate("(i) => visit(i, [i])", i)
        told = page.evaluate("(i) => line(i)", i)
        assert told["solver"] in HOSTILE
        assert told["params"].keys() <= set(HOSTILE)
    page.locator(".plot svg[tabindex]").first.focus()
    page.keyboard.press("ArrowRight")
    after = set(page.evaluate(kinds))
    ours = {"dialog", "div", "h2", "p", "code", "ul", "li", "details", "circle"}
    assert after - before <= ours
    assert not {"img", "iframe", "object"} & after
    assert page.evaluate("[window.broken, document.scripts.length]") == [None, 3]
    assert page.locator("h1").count() == 1
    assert page.evaluate("document.documentElement.scrollWidth") == 1400


def test_the_content_security_policy_blocks_injections(browser, folder):
    context = browser.new_context()
    page = context.new_page()
    refused, stopped = [], []
    page.on("console", lambda message: refused.append(message.text))
    page.on("requestfailed", lambda r: stopped.append((r.url, r.failure)))
    page.goto((folder / "report" / "index.html").as_uri())
    with page.expect_console_message(), page.expect_event("requestfailed"):
        page.evaluate(
            "document.body.insertAdjacentHTML('beforeend', "
            '\'<img src="http://evil.example/x" onerror="window.broken=1">\')'
        )
    assert page.evaluate("window.broken") is None
    assert any("Content Security Policy" in text for text in refused)
    assert stopped == [("http://evil.example/x", "csp")]
    context.close()
