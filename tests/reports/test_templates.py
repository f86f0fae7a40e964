"""Templates of sentences: every macro exists and is used."""

import ast
from pathlib import Path

import pytest
from jinja2 import UndefinedError
from jinja2.nodes import Macro, Name

import mortarbench.reports
from mortarbench.reports.document.layout import Point
from mortarbench.reports.document.templates import Sentences, environment

ROOT = Path(mortarbench.reports.__file__).parent
TEMPLATES = sorted(path for path in ROOT.rglob("*.j2") if path.parent.name != "assets")


@pytest.fixture
def sentences(tmp_path, monkeypatch):
    """Return a factory of sentences from a template in a temporary package."""
    package = tmp_path / f"pages_{tmp_path.name}"
    package.mkdir()
    (package / "__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path)

    def make(text, **names):
        (package / "page.j2").write_text(text, "utf-8")
        return Sentences(f"{package.name}.page", **names)

    return make


def asked(source):
    """Return the names of macros that a module calls, and all of its other strings."""
    names, strings = set(), set()
    for node in ast.walk(ast.parse(source)):
        match node:
            case ast.Call(
                func=ast.Name("TEXT") | ast.Attribute(ast.Name("TEXT"), "parts")
            ):
                if isinstance(node.args[0], ast.Constant):
                    names.add(node.args[0].value)
            case ast.Constant(str(text)):
                strings.add(text)
    return names, strings


@pytest.mark.parametrize("path", TEMPLATES, ids=lambda path: path.stem)
def test_every_sentence_used_by_a_module_is_in_its_template(path):
    tree = environment().parse(path.read_text("utf-8"))
    macros = {macro.name for macro in tree.find_all(Macro)}
    names, strings = asked(path.with_suffix(".py").read_text("utf-8"))
    assert names - macros == set()
    used = strings | {name.name for name in tree.find_all(Name)}
    assert macros - used == set(), "unused macros"


def test_there_are_templates():
    assert len(TEMPLATES) > 10


def test_empty_lines_of_a_template_separate_paragraphs(sentences):
    text = sentences(
        "{% macro said(n) %}\nOne\n  line of {{ n | plural('word') }}.\n\n"
        "{% if n > 5 %}\nmany\n{% endif %}\n\n- A point\n"
        "of two lines.\n{% endmacro %}\n"
    )
    assert text("said", 3) == "One line of 3 words. - A point of two lines."
    parts = text.parts("said", 3)
    assert parts == ["One line of 3 words.", "A point of two lines."]
    assert [type(part) for part in parts] == [str, Point]


def test_an_undefined_name_raises_an_error(sentences):
    text = sentences("{% macro said() %}{{ missing }}{% endmacro %}")
    with pytest.raises(UndefinedError, match="'missing' is undefined"):
        text("said")


def test_text_is_plain_and_names_are_shared_by_macros(sentences):
    text = sentences(
        "{% macro said(x) %}{{ name }} & {{ x }} {{ 0.25 | format('.0%') }}"
        "{% endmacro %}",
        name="<a>",
    )
    assert text("said", "{{ x }}") == "<a> & {{ x }} 25%"
