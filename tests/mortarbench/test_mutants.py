"""Mutations by tools/mutants.py, and consistency of its list with the code."""

import ast
import sys

import pytest

from tests.support import ROOT

sys.path.append(str(ROOT / "tools"))
import mutants


def changes(code):
    found = mutants.mutants_of("m.py", code.encode())
    for m in found:
        ast.parse(m.source)
    return {m.change for m in found}


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("y = a + b", {"a + b -> (a - b)"}),
        ("y = -x", {"-x -> (x)"}),
        ("y = x < z", {"x < z -> (x > z)"}),
        ("y = x < 1", {"x < 1 -> (x > 1)", "x < 1 -> (x <= 1)", "1 -> (2)"}),
        ("y = a or b", {"a or b -> (a and b)", "a or b -> (a)", "a or b -> (b)"}),
        ("y = np.abs(gap).max()", {
            "np.abs(gap).max() -> (np.abs(gap).min())", "np.abs(gap) -> (gap)",
        }),
        ("y = 2.5", {"2.5 -> (5.0)"}),
        ("left.reverse()", {"left.reverse() -> pass"}),
        ("def f():\n    if bad:\n        return\n    go(λ)", {
            "return -> pass", "go(λ) -> pass",
        }),
    ],
)  # fmt: skip
def test_each_mutant_has_one_change(code, expected):
    assert changes(code) == expected


def test_texts_types_and_messages_are_not_mutated():
    code = """
"A docstring."
x: Literal[1, 2]
@cache(3)
def f(a: int | str) -> Literal[4]:
    "Another."
    return f"{a + 5}" + "6"
"""
    assert changes(code) == set()


def test_the_copy_has_every_compiled_module(tmp_path):
    mutants.copy_of_the_project(tmp_path)
    sources = sorted(path.relative_to(ROOT) for path in ROOT.glob("*/*/*.pyx"))

    assert sources
    for source in sources:
        assert list((tmp_path / source).parent.glob(f"{source.stem}.*.so")), source


@pytest.mark.slow
def test_the_list_names_existing_modules_tests_and_mutants():
    plan = mutants.read_plan()
    for module, tests in plan.tests.items():
        assert (ROOT / module).is_file()
        assert (ROOT / tests[0]).is_file()
    for (module, where, change), reason in plan.accepted.items():
        keys = {m.key for m in mutants.mutants_of(module, (ROOT / module).read_bytes())}
        assert (module, where, change) in keys
        assert reason
