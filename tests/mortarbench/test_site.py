"""The site renders all formulas of the documentation."""

import re
import sys
import unicodedata
from functools import cache
from xml.etree import ElementTree

import markdown
import pytest
import yaml

import mortarbench
from mortarbench.harness.record import Record
from tests.support import ROOT

sys.path.append(str(ROOT / "tools" / "site"))
import pages  # the hook of mkdocs

SOURCES = {
    p.name: p
    for p in (
        *ROOT.glob("docs/*.md"),
        *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
    )
}
#: page with Unicode formulas
UNICODE = {"CHANGELOG.md"}
#: characters that occur only in formulas, not in plain text
FORMULA = re.compile(r"[ᵀ‖½√∑Σ∫∂𝒫ᵢⱼₖ⁺λΩ\u0302\u0303]")
CODE = re.compile(r"^```.*?^```$|`[^`]*`|<!--.*?-->", re.DOTALL | re.MULTILINE)


class Loader(yaml.SafeLoader):
    """YAML loader that ignores the Python objects named in mkdocs.yml."""


Loader.add_multi_constructor("", lambda *_: None)


def rendered(text):
    """Return the HTML of a page before the hooks of mkdocs."""
    return markdown.markdown(
        text, extensions=list(extensions()), extension_configs=extensions()
    )


@cache
def extensions():
    """Return the extensions of Markdown and their options in mkdocs.yml."""
    options = yaml.load((ROOT / "mkdocs.yml").read_text("utf-8"), Loader)
    return dict(
        next(iter(e.items())) if isinstance(e, dict) else (e, {})
        for e in options["markdown_extensions"]
    )


def formulas(source):
    """Return the LaTeX code between dollar signs, extracted without Markdown."""
    prose = CODE.sub("", source)
    found = re.findall(
        r"\$\$(.+?)\$\$|(?<![\\$])\$(?!\s)([^$]+?)(?<!\s)\$", prose, re.S
    )
    return sorted(" ".join((a or b).split()) for a, b in found)


@pytest.mark.parametrize("name", sorted(SOURCES))
def test_every_formula_of_a_page_becomes_mathml(name):
    source = SOURCES[name].read_text("utf-8")
    before = rendered(source)
    after = pages.typeset(before)

    arrived = [
        " ".join(pages.html.unescape(tex).split())
        for _, tex in pages.FORMULA.findall(before)
    ]
    assert sorted(arrived) == formulas(source)
    assert after.count("<math") == len(arrived)
    assert "$" not in re.sub(r"<(code|pre)\b.*?</\1>", "", after, flags=re.S)


@cache
def anchors_of(name):
    """Return the identifiers of a page to which links may point."""
    build = pages.GENERATED.get(name)
    text = build() if build else SOURCES[name].read_text("utf-8")
    return set(re.findall(r' id="([^"]+)"', pages.typeset(rendered(text))))


@pytest.mark.parametrize("name", sorted(SOURCES))
def test_every_link_into_a_page_has_a_target(name):
    text = SOURCES[name].read_text("utf-8")
    links = re.findall(r"\]\((?!\w+:)([^)#\s]*)#([^)\s]+)\)", text)
    lost = [
        f"{page}#{anchor}"
        for page, anchor in links
        if anchor not in anchors_of(page.rpartition("/")[2] or name)
    ]

    assert lost == []


@pytest.mark.parametrize("name", sorted(SOURCES.keys() - UNICODE))
def test_no_formula_of_a_page_is_plain_text(name):
    """Outside of code, the characters of `FORMULA` occur only in LaTeX. Other symbols,
    such as superscript digits, may be plain text.
    """
    prose = CODE.sub("", SOURCES[name].read_text("utf-8"))
    prose = unicodedata.normalize("NFD", re.sub(r"\$\$?[^$]+\$\$?", "", prose))

    assert FORMULA.findall(prose) == []


@pytest.mark.parametrize(
    "text", ["‖u*‖ and ‖v*‖", "D(λ*) = J(u*)", "max |x*| and |y*|"]
)
def test_a_formula_damaged_by_markdown_ends_the_build(text):
    with pytest.raises(ValueError, match="emphasis within a word"):
        pages.typeset(rendered(text))
    assert "*" not in rendered(text)  # so the damage is not visible in the text


@pytest.mark.parametrize("tex", [r"\norm{u}", r"\frac{a", r"u^{*"])
def test_a_formula_that_cannot_be_converted_ends_the_build(tex):
    with pytest.raises(ValueError, match="formula"):
        pages.typeset(rendered(f"Let ${tex}$ be."))


def test_letters_and_signs_of_a_formula_are_those_of_its_source():
    html = pages.typeset(rendered(r"$\tfrac12\hat u^{\mathsf T}Ku - f^* \le 10^{-8}$"))
    (formula,) = re.findall(r"<math>.*</math>", html)
    text = "".join(ElementTree.fromstring(formula).itertext())

    assert unicodedata.normalize("NFKC", text) == "12uˆTKu−f∗≤10−8"


def test_the_page_of_records_has_a_row_with_a_range_for_each_field():
    text = pages.record_page()
    rows = [line.split("|")[1:-1] for line in text.splitlines() if "`" in line[:3]]

    assert [row[0].strip(" `") for row in rows] == [*Record.__struct_fields__]
    assert all(row[3].strip() for row in rows)
    assert "| `tol` | number | > 0, ≤ 1 | tolerance passed to the solver |" in text


def test_the_page_of_python_names_describes_every_public_name():
    text = pages.python_page()
    names = re.findall(r"^::: mortarbench\.(?:listing\.)?(\w+)$", text, re.M)

    assert sorted(names) == sorted(mortarbench.__all__)
    assert "::: mortarbench.harness.needs_matrices\n" in text
