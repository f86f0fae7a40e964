"""The page in a browser: offline, by mouse, on phones, in dark mode, hostile names."""

import os
import shutil

import pytest

from mortarbench.reports.measurements import read_measurements
from mortarbench.reports.sections import compose
from mortarbench.reports.writing import write_document
from tests.support.box_records import box_record
from tests.support.measured import measurements
from tests.support.synthetic_results import write

pytestmark = pytest.mark.together  # one browser

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
HOSTILE = (
    '<script>window.broken=1</script>"><img src=http://evil.example/x onerror=a()>',
    "</script><script>window.broken=1</script><!-- ]]> \u2028 \u2029",
    "\u202eright-to-left \u0645\u0631\u062d\u0628\u0627 e\u0301\u0301 \u200b\u200d 🙂",
    "__proto__",
    "x" * 10_000,
)


@pytest.fixture(scope="module")
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


@pytest.fixture(scope="module")
def page_of_a_campaign(tmp_path_factory, svg_only):
    folder = write(tmp_path_factory.mktemp("it's a run"), 4, 24, 3)
    with svg_only():
        write_document(compose(read_measurements(folder)), folder, ["html"])
    return folder / "index.html"


@pytest.fixture
def visit(browser):
    """Open a page; at the end, assert no messages and no requests but for the page."""
    contexts, messages, urls = [], [], []

    def visit(path, width=1200, height=900, **options):
        contexts.append(browser.new_context(**options))
        page = contexts[-1].new_page()
        page.on("console", lambda message: messages.append(message.text))
        page.on("pageerror", lambda error: messages.append(str(error)))
        page.on("request", lambda request: urls.append(request.url))
        page.set_viewport_size({"width": width, "height": height})
        page.goto(path.as_uri())
        return page

    yield visit
    for context in contexts:
        context.close()
    assert messages == []
    assert len(urls) == len(contexts)


@pytest.mark.parametrize(
    ("width", "height", "scheme"), [(1200, 900, "light"), (390, 1200, "dark")]
)
def test_the_first_screen_shows_table_sentences_and_figure(
    visit, page_of_a_campaign, width, height, scheme
):
    page = visit(page_of_a_campaign, width, height, color_scheme=scheme)
    answer = page.locator("#answer")
    for shown in (answer.locator("table"), answer.locator("p").first,
                  answer.locator(".drawing svg")):  # fmt: skip
        box = shown.bounding_box()
        assert 0 <= box["y"] < height
    assert "fastest" in answer.locator("p").first.inner_text()
    assert page.evaluate("document.documentElement.scrollWidth") <= width


def test_text_and_axes_of_figures_take_the_colour_of_the_page(
    visit, page_of_a_campaign
):
    colours = {
        visit(page_of_a_campaign, color_scheme=scheme).evaluate(
            "getComputedStyle(document.querySelector('#answer svg [id*=text] g')).fill"
        )
        for scheme in ("light", "dark")
    }
    assert len(colours) == 2


def test_a_solver_is_hidden_in_all_tables_and_figures(visit, page_of_a_campaign):
    page = visit(page_of_a_campaign)
    parts = page.locator(".solver1")
    count = page.locator(".solver0:visible").count()
    assert min(parts.count(), count) > 15
    page.locator("#solvers summary").click()
    page.get_by_label("solver-b").uncheck()
    assert page.locator(".solver1:visible").count() == 0
    assert page.locator(".solver0:visible").count() == count
    page.get_by_label("solver-b").check()
    assert page.locator(".solver1:visible").count() > 15


def test_curves_name_their_solver_under_the_pointer(visit, page_of_a_campaign):
    titles = visit(page_of_a_campaign).locator("svg .solver2 > title")
    assert set(titles.all_text_contents()) == {"solver-c"}


def test_a_click_on_a_heading_sorts_by_value_and_a_second_click_reverses(
    visit, page_of_a_campaign
):
    table = visit(page_of_a_campaign).locator("#iterations table").first
    head = table.get_by_role("button", name="solver")
    for order in (1, -1):
        head.click()
        shown = table.locator("tbody td:nth-child(2)").all_inner_texts()
        assert shown == sorted(shown)[::order]


def test_a_link_leads_to_each_section(visit, page_of_a_campaign):
    page = visit(page_of_a_campaign)
    page.locator("summary", has_text="Sections").click()
    page.get_by_role("link", name="Accuracy").click()
    top = page.locator("#accuracy h2").bounding_box()["y"]
    assert 0 <= top < 900


def test_without_scripts_the_page_is_complete(visit, page_of_a_campaign):
    page = visit(page_of_a_campaign, java_script_enabled=False)
    assert page.locator("#answer table tbody tr").count() == 2
    assert page.locator("#definitions p").count() > 2


def test_hostile_names_run_no_code_and_request_nothing(visit, tmp_path, svg_only):
    records = [
        box_record(name, n, 1e-3 * n, message=name, options={name: name})
        for name in HOSTILE
        for n in (1, 2, 4)
    ]
    with svg_only():
        write_document(compose(measurements(records)), tmp_path, ["html"])
    page = visit(tmp_path / "index.html")
    assert page.evaluate("window.broken") is None
    assert page.locator("img").count() == 0
    assert page.evaluate("document.documentElement.scrollWidth") <= 1200
