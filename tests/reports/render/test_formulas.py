"""Formulas in prose are complete in HTML and Markdown."""

import re
from types import SimpleNamespace

import pytest

from mortarbench.reports.document.layout import Page, Section
from mortarbench.reports.render.formulas import mathml, split
from mortarbench.reports.render.html_page import html
from mortarbench.reports.render.markdown import markdown
from mortarbench.reports.sections import Analysis
from mortarbench.reports.sections.settings import definitions
from mortarbench.reports.validation.report import TEXT

DEFINITIONS = definitions(Analysis(SimpleNamespace(factor=10.0)))
RULES = Section(name="rules", title="Rules", points=tuple(TEXT.parts("rules")))


def page(section):
    return Page(title="t", dateline="d", sections=(section,))


@pytest.mark.parametrize("section", [DEFINITIONS, RULES])
def test_every_formula_of_a_section_is_typeset(section):
    formulas = [
        tex for text in (*section.prose, *section.points) for tex in split(text)[1::2]
    ]
    written = html(page(section))
    shown = re.findall(r"<math>.*?</math>", written)

    assert len(formulas) > 5
    assert shown == [mathml(tex) for tex in formulas]
    assert r"\(" not in written
    assert [f"${tex}$" in markdown(page(section)) for tex in formulas] == [True] * len(
        formulas
    )


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        (r"\(\input{x}\)", r"\(\input{x}\)"),
        (r"\(a_{\)", r"\(a_{\)"),
        (r"\(<b>\)", "<math><mo>&lt;</mo><mi>b</mi><mo>&gt;</mo></math>"),
    ],
)
def test_a_name_that_looks_like_a_formula_adds_no_markup(name, shown):
    section = Section(name="s", title="S", prose=(f"solver {name} won",))
    (paragraph,) = re.findall(r"<p>solver (.*) won</p>", html(page(section)))

    assert re.sub(r' \w+="[^"]*"', "", paragraph) == shown
