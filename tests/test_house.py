"""The house: what lies in one place only."""

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("harness", "problems", "solvers", "reports", "mortarbench")


def modules():
    """All modules of the packages by their path from the root, parsed."""
    for package in PACKAGES:
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
