"""Structure of the code: unique implementations, sizes of packages, and names."""

import ast
import re
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

from mortarbench.solvers import SOLVERS
from mortarbench.solvers.common.libraries import PACKAGES as LIBRARIES

pytestmark = pytest.mark.together

ROOT = Path(__file__).parents[1]
PACKAGES = ("harness", "problems", "solvers", "reports", "mortarbench")


def modules(*packages):
    """Return (path, text) of all modules of `packages`, default: all five."""
    return [module for package in packages or PACKAGES for module in texts(package)]


@cache
def texts(package):
    return [
        (str(path.relative_to(ROOT)), path.read_text("utf-8"))
        for path in sorted((ROOT / package).rglob("*.py"))
    ]


def users(name):
    """Return the modules that import or look up a dotted name."""
    found = []
    for path, text in modules():
        # only a module that contains all parts of the name needs a syntax tree
        if not all(re.search(rf"\b{part}\b", text) for part in name.split(".")):
            continue
        used = []
        for node in ast.walk(ast.parse(text)):
            match node:
                case ast.Import(names=aliases):
                    used += [alias.name for alias in aliases]
                case ast.ImportFrom(module=str(source), names=aliases):
                    used += [source, *(f"{source}.{alias.name}" for alias in aliases)]
                case ast.Attribute(value=ast.Name(id=source), attr=attr):
                    used.append(f"{source}.{attr}")
        if name in used:
            found.append(path)
    return found


@pytest.mark.parametrize(
    ("name", "homes"),
    [
        # page.py computes the script hash of the content security policy
        ("hashlib", ["harness/digest.py", "reports/page.py"]),
        ("os.replace", ["harness/files/durable.py"]),
        ("os.rename", []),
        ("os.link", []),
        ("shutil.move", []),
        ("tempfile.NamedTemporaryFile", []),
    ],
)
def test_definitions_are_not_duplicated(name, homes):
    assert users(name) == homes


#: packages that contain many similar modules → contents of a module
COLLECTIONS = {
    "solvers/adapters": "a library each",
    "problems/families": "a family each",
}


def test_a_package_contains_at_most_fourteen_modules():
    sizes = Counter(str(Path(path).parent) for path, _ in modules())

    assert {r: n for r, n in sizes.items() if n > 14 and r not in COLLECTIONS} == {}
    assert sizes.keys() >= {"harness", "harness/verify", "solvers/smalbe"}


#: obscure words that names must not contain
RIDDLES = (
    "station", "serving", "workbench", "mistaken", "halving", "planted", "capsule",
    "recipe", "contests", "ladders", "tally", "courses", "worth", "sheets", "wording",
    "wells", "liars", "descents", "crowd",
)  # fmt: skip
#: vague words that must not be the whole name of a module or class
UNSAID = (
    "remote", "node", "generator", "block", "carry_out", "grids", "truth", "agreement",
    "exchange", "rebuilt", "judge", "blank", "conventions", "standing", "matched",
    "setting", "traces", "emit", "content", "search", "msh", "twosided", "certify",
    "outer", "inner", "arm",
)  # fmt: skip


def words(name):
    """Split the name of a module, class or function into words."""
    return [w.lower() for w in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", name)]


#: definition in a module, or in a program that is a string of a test
DEFINITION = re.compile(r"^ *(?:async )?(?:(class)|def) +(?!_|test_)(\w+)", re.M)


def names():
    """Yield path, type and name of modules, classes and public functions."""
    for path, text in modules(*PACKAGES, "tests"):
        yield path, "module", Path(path).stem
        # syntax trees of all tests would take seconds
        for kind, name in DEFINITION.findall(text):
            yield path, kind or "function", name


def test_no_solver_uses_the_judge():
    """Solvers stop by a test of their own, not by the residuals that judge answers."""
    sources = [
        path
        for path in (ROOT / "solvers").rglob("*")
        if path.suffix in (".py", ".pyi", ".pyx", ".pxi", ".pxd", ".h")
    ]
    judge = re.compile(r"harness[./]verify|kkt_residuals|scales\.h|certify")

    assert len(sources) > 50
    assert [p for p in sources if judge.search(p.read_text("utf-8"))] == []


def test_every_package_is_pinned_once():
    lines = (ROOT / "constraints.txt").read_text("utf-8").splitlines()
    pins = [line.partition("==")[0].strip() for line in lines if "==" in line]
    names = Counter(re.sub("[-_.]+", "-", pin).lower() for pin in pins)
    assert len(names) > 100
    assert {name for name, count in names.items() if count > 1} == set()


def test_names_are_technical_terms():
    found = [
        f"{path}: {kind} {name}"
        for path, kind, name in names()
        if set(words(name)) & set(RIDDLES)
        or (kind != "function" and "_".join(words(name)) in UNSAID)
    ]

    assert found == []


def test_the_harness_names_no_solver_and_no_unit_of_physics():
    """Names of solvers and units are data and do not occur in the code of harness.

    The exception is `equivalence`, which compares three systems of units.
    """
    prefixes = {re.split("[-:]", name)[0] for name in SOLVERS}
    solvers = {*prefixes, *(p.lower() for p in LIBRARIES)} - {"py-mkl-pardiso"}
    units = {"Pa", "MPa", "GPa", "N/m", "J/m", "SI", "mm", "kN", "GN"}
    found = []
    for path, source in modules("harness"):
        tree = ast.parse(source)
        docs = {
            id(node.body[0].value)
            for node in ast.walk(tree)
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef)
            and isinstance(node.body[0], ast.Expr)
        }
        for node in ast.walk(tree):
            match node:
                case ast.Constant(value=str(text)) if id(node) not in docs:
                    said = set(re.findall(r"[\w/-]+", text))
                    if said & units or {w.lower() for w in said} & solvers:
                        found.append((path, text))
                case ast.Name(id=text) | ast.ClassDef(name=text):
                    if set(words(text)) & solvers:
                        found.append((path, text))

    # the QP of other libraries' problems is compiled by those libraries
    converters = [text for path, text in found if path == "harness/qp.py"]
    assert all("cvxpy" in text or text == "OSQP" for text in converters)
    assert {path for path, _ in found} - {"harness/qp.py"} == {
        "harness/conformance/metamorphic.py"
    }


def import_statements(text, indent=""):
    """Yield the statements of a module that are executed when it is imported."""
    for statement in re.split(rf"(?m)^(?={indent}[^\s)])", text):
        if statement.startswith(f"{indent}class "):
            yield from import_statements(statement.partition("\n")[2], indent + "    ")
        elif not re.match(" *(async )?def ", statement):
            yield statement


def test_random_data_of_a_test_do_not_depend_on_other_tests():
    """A generator that several tests share makes their data depend on their order."""
    generator = re.compile(
        r"^(?!.*\blambda\b).*\b(default_rng|Generator|RandomState|Random)\(", re.M
    )
    example = "import random\n\nclass Test:\n    rng = np.random.default_rng(1)\n"
    assert any(map(generator.search, import_statements(example)))

    shared = [
        (path, statement)
        for path, text in modules("tests")
        for statement in import_statements(text)
        if generator.search(statement)
    ]
    assert shared == []
