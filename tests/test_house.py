"""The house: what lies in one place only, how large rooms are, and what names say."""

import ast
import re
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("harness", "problems", "solvers", "reports", "mortarbench")


def modules(*packages):
    """All modules of the five packages, or of others, by their path, parsed."""
    for package in packages or PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            yield str(path.relative_to(ROOT)), ast.parse(path.read_text("utf-8"))


def users(name):
    """Modules that import or look up a thing by its dotted name, or from its module."""
    module, _, attribute = name.rpartition(".")
    for path, tree in modules():
        for node in ast.walk(tree):
            match node:
                case ast.Import(names=aliases):
                    found = name in [alias.name for alias in aliases]
                case ast.ImportFrom(module=source, names=aliases):
                    found = source == name or (
                        source == module and attribute in [a.name for a in aliases]
                    )
                case ast.Attribute(value=ast.Name(id=source), attr=attr):
                    found = (source, attr) == (module, attribute)
                case _:
                    found = False
            if found:
                yield path
                break


@pytest.mark.parametrize(
    ("name", "homes"),
    [
        # the hash that a page's content security policy asks for is no digest of ours
        ("hashlib", ["harness/digest.py", "reports/render/html_page.py"]),
        ("os.replace", ["harness/files/durable.py"]),
        ("os.rename", []),
        ("os.link", ["harness/files/durable.py"]),
        ("shutil.move", []),
        ("tempfile.NamedTemporaryFile", []),
    ],
)
def test_one_thing_is_done_in_one_place(name, homes):
    assert list(users(name)) == homes


#: rooms that are collections of equals: one module each for an adapter, …
COLLECTIONS = {
    "solvers/adapters": "a library each",
    "problems/families": "a family each",
    "reports/sections": "a section of the report each",
    "mortarbench": "a function of the front door each, with what it returns",
    "mortarbench/cli": "a command each",
}


def test_a_room_holds_at_most_fourteen_modules():
    sizes = Counter(str(Path(path).parent) for path, _ in modules())

    assert {r: n for r, n in sizes.items() if n > 14 and r not in COLLECTIONS} == {}
    assert sizes.keys() >= {"harness", "harness/verify", "solvers/smalbe"}


#: names of the past that say nothing to a reader from outside, as words of a name
RIDDLES = [
    "station",
    "serving",
    "workbench",
    "mistaken",
    "halving",
    "planted",
    "capsule",
    "recipe",
    "contests",
    "ladders",
    "tally",
    "courses",
    "worth",
    "sheets",
    "wording",
    "wells",
    "liars",
    "descents",
    "crowd",
    "carryout",
]
#: as the whole name of a module or class: what they hold has a better one
UNSAID = [
    "remote",
    "node",
    "generator",
    "block",
    "grids",
    "truth",
    "agreement",
    "exchange",
    "rebuilt",
    "judge",
    "blank",
    "conventions",
    "standing",
    "matched",
    "setting",
    "traces",
    "emit",
    "content",
    "search",
    "msh",
    "twosided",
    "certify",
    "outer",
    "inner",
    "arm",
]


def words(name):
    """Split a name of a module, class or function into its words."""
    return [w.lower() for w in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", name)]


def names():
    """Modules, classes and public functions of the packages and of the tests."""
    for path, tree in [*modules(), *modules("tests")]:
        yield path, "module", Path(path).stem
        for node in ast.walk(tree):
            match node:
                case ast.ClassDef(name=name) if not name.startswith("_"):
                    yield path, "class", name
                case ast.FunctionDef(name=name) if not name.startswith(("_", "test_")):
                    yield path, "function", name


def test_names_are_words_of_the_field():
    found = [
        f"{path}: {kind} {name}"
        for path, kind, name in names()
        if set(words(name)) & set(RIDDLES)
        or (kind != "function" and "_".join(words(name)) in UNSAID)
    ]

    assert found == []
