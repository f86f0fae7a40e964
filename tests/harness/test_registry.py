"""Registries: solvers by name, options by name and type, plug-ins by path."""

import json
import sys
from dataclasses import dataclass
from typing import Any, Literal

import pytest

from mortarbench.harness import InputError
from mortarbench.harness.registry import (
    PluginFile,
    Registry,
    SolverSpec,
    check_solver,
    load_plugin,
    merged,
    options_of,
    resolve,
)
from mortarbench.registries import Registries
from tests.support.refusals import refused


@dataclass(frozen=True)
class Method:
    max_iter: int = 200
    alpha: float = 1.5
    scaling: bool = True
    mode: str = "fast"
    seed: int | None = None

    def __post_init__(self):
        if self.max_iter < 1:
            raise ValueError("max_iter must be positive,\ngot less")

    def declines(self, qp):
        return None

    def prepare(self, qp, tol):
        raise AssertionError("it is only named, never run")


@dataclass(frozen=True)
class Generic(Method):
    backend: str = ""

    def backends(self):
        return ("daqp", "scs")


@dataclass(frozen=True)
class Open(Method):
    """Generic adapter that cannot list its backends."""

    backend: str = ""


SOLVERS = {
    "method": Method(),
    "method-slow": Method(max_iter=9),
    "generic:*": Generic(),
    "open:*": Open(),
    "open:tuned": Open(backend="tuned", alpha=9.0),
}


def spec(name, **options):
    return SolverSpec(name=name, label=name, options=options)


def test_an_exact_name_returns_the_entry_with_replaced_options():
    assert resolve(spec("method-slow"), SOLVERS) is SOLVERS["method-slow"]
    assert resolve(spec("method-slow", alpha=2), SOLVERS) == Method(9, 2.0)
    assert SOLVERS["method-slow"] == Method(9)


def test_a_wildcard_entry_takes_the_text_after_the_colon_as_backend():
    solver = resolve(spec("generic:scs", max_iter=7), SOLVERS)

    assert solver == Generic(backend="scs", max_iter=7)
    assert resolve(spec("open:anything"), SOLVERS) == Open(backend="anything")


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        (spec("metod"), "unknown solver 'metod'; did you mean 'method'? known: "),
        (spec("generic"), "unknown solver 'generic'; did you mean 'generic:*'? "),
        (
            spec("generic:dapq"),
            "unknown backend of generic 'dapq'; did you mean 'daqp'? known: daqp, scs",
        ),
        (spec("open:*"), "open:* names no backend; write open:NAME"),
        (
            spec("method", max_itr=9),
            "method: unknown option 'max_itr'; did you mean 'max_iter'? known: ",
        ),
        (spec("generic:scs", backend="daqp"), "generic:scs: unknown option 'backend'"),
        (spec("method", max_iter=0), "method: max_iter must be positive, got less"),
    ],
)
def test_an_invalid_solver_is_reported_in_one_line(asked, message):
    with refused(start=message):
        resolve(asked, SOLVERS)


PLUGIN = """
from __future__ import annotations
from dataclasses import dataclass

@dataclass(frozen=True)
class Mine:
    tries: int = 3
    def declines(self, qp): return None
    def prepare(self, qp, tol): raise AssertionError("it is only named, never run")

SOLVERS = {"mine": Mine(), "mine-9": Mine(9)}
"""


def test_a_file_with_a_frozen_dataclass_is_a_plugin(tmp_path):
    file = tmp_path / "plug.py"
    file.write_text(PLUGIN)

    plugin = load_plugin(file)

    assert options_of(plugin.solvers["mine-9"]) == {"tries": 9}
    assert plugin.problems == {}


FAMILY = """
from dataclasses import dataclass
from mortarbench import Family

@dataclass(frozen=True)
class Mine(Family):
    forms = {forms}
    {key}
    def build(self, form, reference): raise AssertionError("never run")

PROBLEMS = {{"a": {made}}}
"""


def family(key="n: int = 1", forms="('p',)", made="Mine()"):
    return FAMILY.format(forms=forms, key=key, made=made)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "import nothing_of_that_name",
            "failed to import: ModuleNotFoundError: No mod",
        ),
        ("raise SystemExit(3)", "failed to import: SystemExit: 3"),
        ("solvers = {}", "defines neither SOLVERS nor PROBLEMS"),
        ("SOLVERS = [1]", "SOLVERS is of type list; expected dict"),
        ("SOLVERS = {'a': 1}", "SOLVERS['a']: 1 is of type int; expected a so"),
        (
            PLUGIN + "SOLVERS = {3: Mine()}",
            "SOLVERS[3]: the key is not a string",
        ),
        (
            PLUGIN + "SOLVERS = {'a': Mine}",
            "SOLVERS['a']: Mine is a class; expected an i",
        ),
        ("PROBLEMS = {'a': 1}", "PROBLEMS['a']: of type int; expected a froz"),
        (
            family("n: int | str = 1"),
            "failed to import: InputError: key n is annotated",
        ),
        (
            family("n: int", made="Mine(1)"),
            "failed to import: InputError: key n has no default; ",
        ),
        (family(made="Mine(2)"), "PROBLEMS['a']: n = 2; expected the default of the"),
        (family(forms="'dual'"), "PROBLEMS['a']: forms = 'dual'; expected a tuple of"),
    ],
)
def test_an_invalid_plugin_is_reported_in_one_line(tmp_path, text, message):
    file = tmp_path / "plug.py"
    file.write_text(text)

    with refused(start=f"{file}: {message}"):
        load_plugin(file)


def test_a_plugin_that_is_missing_or_not_a_python_file_is_refused(tmp_path):
    text = tmp_path / "plug.txt"
    text.write_text(PLUGIN)

    with pytest.raises(InputError, match=r"gone\.py: no such file; expected a Python"):
        load_plugin(tmp_path / "gone.py")
    with pytest.raises(
        InputError, match=r"plug\.txt: not a Python file; its name must"
    ):
        load_plugin(text)


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Return a function that installs a package with only metadata and entry points."""

    def install(metadata, offers):
        folder = tmp_path / "installed" / metadata
        folder.mkdir(parents=True)
        (folder / "entry_points.txt").write_text(offers)
        monkeypatch.syspath_prepend(folder.parent)
        return folder.parent

    return install


@pytest.mark.parametrize("metadata", ["its-1.0.dist-info", "its.egg-info"])
def test_entry_points_are_imported_when_their_names_are_used(install, metadata):
    folder = install(metadata, "[mortarbench.solvers]\nmine = its_own:MINE\n")
    (folder / "its_own.py").write_text(f"{PLUGIN}\nMINE = SOLVERS['mine']")
    solvers = Registry({"osqp": "no:SUCH"}, check_solver, "mortarbench.solvers")

    assert "its_own" not in sys.modules
    assert solvers["mine"].tries == 3


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("no_such_module:X", "no_such_module:X: failed to import: ModuleNotFound"),
        ("fractions:X", "fractions:X: failed to import: AttributeError"),
        (
            "fractions:Fraction",
            "fractions:Fraction, registered as 'mine': .*expected a",
        ),
    ],
)
def test_an_entry_that_is_not_a_solver_is_named(place, message):
    with pytest.raises(InputError, match=message):
        Registry({"mine": place}, check_solver)["mine"]


def test_a_name_that_exists_cannot_be_taken_by_a_plugin():
    assert dict(merged("solver", {"a": 1}, {"b": 2})) == {"a": 1, "b": 2}
    with pytest.raises(InputError, match="solver 'a' of the plug-in already exists"):
        merged("solver", {"a": 1}, {"a": 2})


# two versions of plug-ins, and plug-ins with neighbour modules

WITH_NEIGHBOURS = """
import helper
from tools.speed import FAST
from dataclasses import dataclass

@dataclass(frozen=True)
class Mine:
    def declines(self, qp):
        from late import WHY
        return f"{WHY} {helper.VERSION} {FAST}"
    def prepare(self, qp, tol): raise AssertionError("it is only named, never run")

SOLVERS = {"mine": Mine()}
"""


def version(folder, number):
    """Write a plug-in and neighbour modules that contain a version; return its path."""
    (folder / "tools").mkdir(parents=True)
    (folder / "mine.py").write_text(WITH_NEIGHBOURS)
    (folder / "helper.py").write_text("from constants import VERSION")
    (folder / "constants.py").write_text(f"VERSION = {number}")
    (folder / "late.py").write_text(f"WHY = 'late {number}'")
    (folder / "tools" / "__init__.py").write_text("")
    (folder / "tools" / "speed.py").write_text(f"FAST = 'fast {number}'")
    return folder / "mine.py"


@pytest.fixture(autouse=True)
def own_path(monkeypatch):
    """Restore `sys.path` and `sys.modules` after each test."""
    monkeypatch.setattr(sys, "path", [*sys.path])
    before = set(sys.modules)
    yield
    for name in set(sys.modules) - before:
        del sys.modules[name]


def test_two_versions_of_a_plugin_import_separate_neighbour_modules(tmp_path):
    """Imports in calls find the neighbours of the plug-in that was loaded first."""
    files = {n: version(tmp_path / f"v{n}", n) for n in (2, 1)}
    solvers = {}
    for number, file in files.items():
        solvers |= load_plugin(f"v{number}={file}").solvers

    assert {name: solver.declines(None) for name, solver in solvers.items()} == {
        "v2:mine": "late 2 2 fast 2",
        "v1:mine": "late 2 1 fast 1",
    }
    assert not {"helper", "constants", "tools.speed"} & set(sys.modules)


def test_the_worker_of_a_labelled_solver_loads_its_own_plugin_first(tmp_path):
    files = [f"v{n}={version(tmp_path / f'v{n}', n)}" for n in (1, 2)]
    registries = Registries().with_files(files)

    for label in ("v1", "v2"):
        command = registries.worker_command(spec(f"{label}:mine"))
        (first, _) = json.loads(command[-1])["plugins"]
        assert first.startswith(f"{label}=")


def test_modules_beside_a_plugin_replace_no_loaded_module(tmp_path):
    for name in ("json", "mortarbench"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('mine')")
    file = tmp_path / "plug.py"
    file.write_text(f"{PLUGIN}\nimport json, mortarbench\nfrom mortarbench import QP")

    assert list(load_plugin(file).solvers) == ["mine", "mine-9"]


@pytest.mark.parametrize(
    "changed", ["mine.py", "helper.py", "constants.py", "late.py", "tools/speed.py"]
)
def test_the_code_digest_of_a_plugin_includes_neighbour_modules(tmp_path, changed):
    file = version(tmp_path / "v", 1)
    (tmp_path / "v" / "unused.py").write_text("a = 1")
    before = b"".join(PluginFile(file).content())
    (tmp_path / "v" / "unused.py").write_text("a = 2")
    same = b"".join(PluginFile(file).content())
    with (tmp_path / "v" / changed).open("a") as code:
        code.write("\n# slower\n")

    assert before == same
    assert b"".join(PluginFile(file).content()) != before


@pytest.mark.parametrize(
    ("text", "path", "label", "name"),
    [
        ("a/b.py", "a/b.py", "", "b.py"),
        ("new=a/b.py", "a/b.py", "new", "new=b.py"),
        ("v1.2-x=b.py", "b.py", "v1.2-x", "v1.2-x=b.py"),
        ("./a=b.py", "a=b.py", "", "a=b.py"),
        ("=b.py", "=b.py", "", "=b.py"),
    ],
)
def test_a_label_precedes_the_path_of_a_plugin(text, path, label, name):
    file = PluginFile.of(text)

    assert (str(file.path), file.label, file.name) == (path, label, name)
    assert PluginFile.of(str(file.resolved())) == file.resolved()


@dataclass(frozen=True)
class Wide:
    rho: float = 1  # an int, as users may write
    steps: int = 1e4
    norm: Literal["max", 2] = "max"
    weight: float | None = 1
    start: Any = 0

    declines, prepare = Method.declines, Method.prepare


@pytest.mark.parametrize("default", [Wide(), Wide(rho=10), Wide(rho=2.5)])
@pytest.mark.parametrize("value", [0.1, 2, 2.0, 1e-3])
def test_the_annotation_of_an_option_decides_its_type(default, value):
    found = resolve(spec("wide", rho=value), {"wide": default}).rho

    assert found == value
    assert type(found) is float


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"rho": "much"}, "rho = 'much'; expected a number"),
        ({"rho": True}, "rho = True; expected a number"),
        ({"norm": 1.5}, "norm = 1.5; expected max or 2"),
        ({"start": 0.5}, "start = 0.5; expected an integer"),
    ],
)
def test_a_value_of_another_type_than_annotated_is_refused(options, message):
    with pytest.raises(InputError) as refused:
        resolve(spec("wide", **options), {"wide": Wide()})

    assert str(refused.value) == f"wide: {message}"
