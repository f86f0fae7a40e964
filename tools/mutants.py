"""Mutation testing: change single expressions of modules and run their tests.

A mutant is one module with one changed operator, constant, function or statement
(Offutt, Lee, Rothermel, Untch and Zapf, ACM Trans. Softw. Eng. Methodol. 5, 1996). If a
test fails, the mutant is killed; if all tests pass, it survives, which shows that no
test detects this change. `tests/mutants.toml` lists the modules, their tests and the
survivors that are accepted, with reasons. The exit code is 1 if another one survives.

The sample of mutants depends only on their text, so that a change in one function
hardly affects the sample in others. The tests run in a copy of the project.

Usage: python tools/mutants.py [MODULE ...] [--most N]
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import os
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parent.parent
PLAN = ROOT / "tests" / "mutants.toml"
#: A mutant counts as hanging if its tests take longer than SLOWER times the usual time
#: of these tests plus GRACE seconds.
SLOWER, GRACE = 5.0, 20.0
_PAIRS = (
    (ast.Add, ast.Sub), (ast.Mult, ast.Div), (ast.BitAnd, ast.BitOr),
    (ast.And, ast.Or), (ast.Lt, ast.GtE), (ast.Gt, ast.LtE), (ast.Eq, ast.NotEq),
    (ast.Is, ast.IsNot), (ast.In, ast.NotIn),
)  # fmt: skip
OPERATORS: dict[type[ast.AST], Any] = {
    a: b for pair in _PAIRS for a, b in (pair, pair[::-1])
}
_NAMES = (
    ("min", "max"), ("minimum", "maximum"), ("any", "all"), ("floor", "ceil"),
    ("argmin", "argmax"),
)  # fmt: skip
FUNCTIONS = {a: b for pair in _NAMES for a, b in (pair, pair[::-1])}
DROPPED = ("abs", "sqrt", "sorted")  #: functions that are replaced by their argument
#: parts of the syntax that are types or messages
SKIPPED = {
    ast.AnnAssign: ("annotation",),
    ast.arg: ("annotation",),
    ast.FunctionDef: ("decorator_list", "returns"),
    ast.ClassDef: ("decorator_list", "bases"),
    ast.Raise: ("exc", "cause"),
    ast.Assert: ("msg",),
    ast.JoinedStr: ("values",),
}


class Mutant(NamedTuple):
    """Module with one change."""

    line: int  #: line of the change
    change: str  #: ``function: old -> new``, numbered if it occurs several times
    source: bytes  #: changed source of the module

    @property
    def rank(self) -> bytes:
        """Pseudo-random bytes that depend only on the change."""
        return hashlib.sha256(self.change.encode()).digest()


def mutants_of(source: bytes) -> list[Mutant]:
    """Return all mutants of a module, in the order of the syntax tree."""
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    mutants: dict[str, Mutant] = {}
    for where, node, new in _changes(ast.parse(source)):
        begin = starts[node.lineno - 1] + node.col_offset
        end = starts[(node.end_lineno or 0) - 1] + (node.end_col_offset or 0)
        text = f"{where}: {' '.join(ast.unparse(node).split())} -> {ast.unparse(new)}"
        change, number = text, 1
        while change in mutants:
            number += 1
            change = f"{text} ({number})"
        changed = source[:begin] + f"({ast.unparse(new)})".encode() + source[end:]
        if isinstance(node, ast.stmt):
            changed = source[:begin] + b"pass" + source[end:]
        mutants[change] = Mutant(node.lineno, change, changed)
    return list(mutants.values())


def _changes(
    tree: ast.AST, where: str = "module"
) -> Iterator[tuple[str, ast.expr | ast.stmt, ast.AST]]:
    """Yield the function of each change, the node to replace and the new node."""
    for field, value in ast.iter_fields(tree):
        if field in SKIPPED.get(type(tree), ()):
            continue
        for child in value if isinstance(value, list) else [value]:
            if isinstance(child, ast.expr | ast.stmt):
                yield from ((where, child, new) for new in _replacements(child))
            if isinstance(child, ast.AST):
                named = isinstance(child, ast.FunctionDef | ast.ClassDef)
                yield from _changes(child, child.name if named else where)


def _replacements(node: ast.expr | ast.stmt) -> Iterator[ast.AST]:
    """Yield the changes of one node, but not of its parts."""
    match node:
        case ast.BinOp(left, op, right) if type(op) in OPERATORS:
            yield ast.BinOp(left, OPERATORS[type(op)](), right)
        case ast.Compare(left, [op], right):
            yield ast.Compare(left, [OPERATORS[type(op)]()], right)
        case ast.BoolOp(op, values):
            yield ast.BoolOp(OPERATORS[type(op)](), values)
        case ast.UnaryOp(ast.USub() | ast.Not() | ast.Invert(), operand):
            yield operand
        case ast.Constant(int() | float() as value):
            flag = isinstance(value, bool)
            yield ast.Constant(not value if flag else 2 * value + (value == 0))
        case ast.Call(ast.Name(name) | ast.Attribute(_, name), [argument]) if (
            name in DROPPED
        ):
            yield argument
        case ast.Name(name) | ast.Attribute(_, name) if name in FUNCTIONS:
            yield ast.Name(ast.unparse(node).removesuffix(name) + FUNCTIONS[name])
        case ast.Expr(ast.Call()) | ast.AugAssign() | ast.Raise() | ast.Continue():
            yield ast.Pass()


def fails(folder: Path, tests: list[str], limit: float | None = None) -> str:
    """Run tests in a copy of the project; return the first failure, or "".

    limit : time limit in s
    """
    command = [
        sys.executable,
        "-m",
        "pytest",
        "-xq",
        "--tb=no",
        "-p",
        "no:cacheprovider",
    ]
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    try:
        run = subprocess.run(
            [*command, *tests], cwd=folder, env=environment, timeout=limit,
            capture_output=True, text=True, check=False,
        )  # fmt: skip
    except subprocess.TimeoutExpired:
        return f"longer than {limit:.0f} s"
    return run.stdout.strip()[-200:] or "crash" if run.returncode else ""


def survivors(
    folder: Path, module: str, tests: list[str], most: int
) -> tuple[int, list[Mutant]]:
    """Return the number of mutants of a sample, and those that survive.

    Raises
    ------
    SystemExit
        If the tests of the unchanged module fail.

    """
    path, start = folder / module, monotonic()
    if failure := fails(folder, tests):
        raise SystemExit(f"{module}: tests of the unchanged module fail: {failure}")
    limit, original = GRACE + SLOWER * (monotonic() - start), path.read_bytes()
    chosen = sorted(mutants_of(original), key=lambda m: m.rank)[:most]
    alive = []
    for mutant in chosen:
        # bytecode counts as current if size and time (in s) of its source are equal
        for bytecode in (path.parent / "__pycache__").glob(f"{path.stem}.*.pyc"):
            bytecode.unlink()
        path.write_bytes(mutant.source)
        if not fails(folder, tests, limit):
            alive.append(mutant)
    path.write_bytes(original)
    return len(chosen), alive


def main() -> int:
    """Run the mutants of the requested modules, print survivors; return 0 or 1."""
    plan = tomllib.loads(PLAN.read_text("utf-8"))
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("modules", nargs="*", metavar="MODULE", help="default: all")
    parser.add_argument("--most", type=int, default=20, help="mutants of each module")
    args = parser.parse_args()
    if unknown := set(args.modules) - set(plan):
        parser.error(f"{', '.join(sorted(unknown))}: not in tests/mutants.toml")
    code = 0
    with TemporaryDirectory(prefix="mortarbench-mutants-") as scratch:
        folder = Path(scratch) / "copy"
        ignored = shutil.ignore_patterns(".*", "out", "__pycache__")
        shutil.copytree(ROOT, folder, symlinks=True, ignore=ignored)
        for module in args.modules or plan:
            accepted = plan[module].get("accepted", {})
            number, alive = survivors(folder, module, plan[module]["tests"], args.most)
            new = [m for m in alive if m.change not in accepted]
            print(f"{module}: {number - len(alive)} of {number} killed", flush=True)
            for mutant in new:
                print(f"  line {mutant.line}, {mutant.change}", flush=True)
            code |= bool(new)
    return code


if __name__ == "__main__":
    sys.exit(main())
