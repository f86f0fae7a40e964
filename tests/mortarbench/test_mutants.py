"""Mutations by tools/mutants.py, and consistency of its list with the code."""

import ast
import sys
import tomllib

import pytest

from tests.support import ROOT

sys.path.append(str(ROOT / "tools"))
import mutants


def changes(code):
    found = mutants.mutants_of(code.encode())
    for m in found:
        ast.parse(m.source)
    return {m.change.partition(": ")[2] for m in found}


@pytest.mark.parametrize(
    ("code", "expected"),
    [
        ("y = a + b", {"a + b -> a - b"}),
        ("y = -x", {"-x -> x"}),
        ("y = x < 1", {"x < 1 -> x >= 1", "1 -> 2"}),
        ("y = a or b", {"a or b -> a and b"}),
        ("y = np.abs(gap).max()", {
            "np.abs(gap).max -> np.abs(gap).min", "np.abs(gap) -> gap",
        }),
        ("y = 2.5 * 0", {"2.5 * 0 -> 2.5 / 0", "2.5 -> 5.0", "0 -> 1"}),
        ("left.reverse()", {"left.reverse() -> pass"}),
        ("def f():\n    if not bad:\n        go(λ)", {
            "not bad -> bad", "go(λ) -> pass",
        }),
        # texts, types and messages are not changed
        ("@cache(3)\ndef f(a: int | str) -> Literal[4]: return f'{a + 5}'", set()),
    ],
)  # fmt: skip
def test_each_mutant_has_one_change(code, expected):
    assert changes(code) == expected


@pytest.mark.slow
def test_the_list_names_existing_modules_tests_and_mutants():
    for module, plan in tomllib.loads(mutants.PLAN.read_text("utf-8")).items():
        assert all((ROOT / test).is_file() for test in plan["tests"])
        found = {m.change for m in mutants.mutants_of((ROOT / module).read_bytes())}
        assert set(plan.get("accepted", ())) <= found
