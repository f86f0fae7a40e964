"""Mutation testing: change single expressions of modules and run the tests.

A mutant is a copy of the project with one change in an expression or statement of a
module, such as another sign, comparison or constant, or a removed guard. The tests of
the module are run on the mutant. If a test fails, the mutant is killed; if all tests
pass, it survives, which shows that no test detects this change. `tests/mutants.toml`
lists the modules, their tests, the number of mutants per module, and accepted survivors
with reasons. The exit code is 1 if a mutant survives that is not accepted.

The selection of mutants depends only on their text, so that a change in one function
hardly affects the selection in other functions. The working tree is not modified.

Usage: python tools/mutants.py [MODULE ...] [--most N]
"""

from __future__ import annotations

import argparse
import ast
import hashlib
import os
import shutil
import signal
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from copy import deepcopy
from dataclasses import dataclass
from importlib import import_module
from importlib.util import find_spec
from math import inf
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from tempfile import TemporaryDirectory
from time import monotonic, sleep
from typing import cast

import pytest

ROOT = Path(__file__).resolve().parent.parent
PLAN = ROOT / "tests" / "mutants.toml"
#: A mutant counts as hanging if its tests take longer than SLOWER times the usual time
#: of these tests plus GRACE seconds.
SLOWER, GRACE = 5.0, 20.0
MAX_LENGTH = 100  #: largest number of characters of code in a description
#: libraries that each laboratory imports once for all mutants
LIBRARIES = ("hypothesis", "pandas", "scipy.sparse.linalg", "scipy.stats")

OPERATORS: dict[type[ast.AST], type[ast.AST]] = {
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult,
    ast.Pow: ast.Mult,
    ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd,
    ast.And: ast.Or,
    ast.Or: ast.And,
    ast.Lt: ast.Gt,
    ast.Gt: ast.Lt,
    ast.LtE: ast.GtE,
    ast.GtE: ast.LtE,
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.In: ast.NotIn,
    ast.NotIn: ast.In,
}
#: Changes that are made only if the comparison contains a count or an integer, because
#: floats are so rarely equal that tests would not detect the change.
BOUNDARIES: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.LtE,
    ast.LtE: ast.Lt,
    ast.Gt: ast.GtE,
    ast.GtE: ast.Gt,
}
FUNCTIONS = {
    "min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum",
    "any": "all", "all": "any", "floor": "ceil", "ceil": "floor",
    "argmin": "argmax", "argmax": "argmin",
}  # fmt: skip
#: functions whose calls are replaced by their argument
DROPPED = ("abs", "sqrt", "sorted")
COUNTS = ("len", "size", "sum", "shape")  #: names whose values are counts

Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True)
class Mutant:
    """Module with one change."""

    module: str  #: path relative to the root of the project
    where: str  #: dotted name of the function or class; "" at module level
    change: str  #: ``old -> new``, numbered if the same change occurs several times
    line: int  #: line number of the change
    source: bytes  #: changed source of the whole module

    @property
    def key(self) -> tuple[str, str, str]:
        """Identity of a mutant in the list of survivors, without its line number."""
        return self.module, self.where, self.change

    @property
    def rank(self) -> bytes:
        """Pseudo-random bytes that depend only on `key`."""
        return hashlib.sha256("\0".join(self.key).encode()).digest()


@dataclass(frozen=True)
class Plan:
    """Contents of `tests/mutants.toml`."""

    most: int  #: largest number of mutants per module
    tests: dict[str, list[str]]  #: arguments of pytest by module
    accepted: dict[tuple[str, str, str], str]  #: reasons of accepted survivors, by key


# ---- mutating


def mutants_of(module: str, source: bytes) -> list[Mutant]:
    """Return all mutants of a module, in the order of the changes in the source."""
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    seen: Counter[tuple[str, str]] = Counter()
    mutants = []
    for where, node, new in _changes(ast.parse(source)):
        assert node.end_lineno is not None
        assert node.end_col_offset is not None
        begin = starts[node.lineno - 1] + node.col_offset
        end = starts[node.end_lineno - 1] + node.end_col_offset
        text = f"{_shown(ast.unparse(node))} -> {_shown(new)}"
        seen[where, text] += 1
        if (number := seen[where, text]) > 1:
            text += f" ({number})"
        changed = source[:begin] + new.encode() + source[end:]
        mutants.append(Mutant(module, where, text, node.lineno, changed))
    return mutants


def _shown(code: str) -> str:
    one_line = " ".join(code.split())
    return one_line if len(one_line) <= MAX_LENGTH else one_line[: MAX_LENGTH - 1] + "…"


def _changes(
    tree: ast.AST, where: str = ""
) -> Iterator[tuple[str, ast.expr | ast.stmt, str]]:
    """Yield changes of code that affect results rather than types or messages.

    Each change consists of the dotted name of its function or class, the node to
    replace and the new source of this node.
    """
    for child in _children(tree):
        name = where
        if isinstance(child, Function | ast.ClassDef):
            name = f"{where}.{child.name}".lstrip(".")
        if isinstance(child, ast.expr) and isinstance(
            getattr(child, "ctx", ast.Load()), ast.Load
        ):
            for new in _expressions(child):
                yield where, child, f"({ast.unparse(new)})"
        if isinstance(child, ast.stmt) and _is_removable(child, tree):
            yield where, child, "pass"
        yield from _changes(child, name)


def _children(node: ast.AST) -> Iterator[ast.AST]:
    skipped = {
        ast.AnnAssign: ("annotation",),
        ast.arg: ("annotation",),
        ast.FunctionDef: ("decorator_list", "returns"),
        ast.ClassDef: ("decorator_list", "bases"),
        ast.Raise: ("exc", "cause"),
        ast.ExceptHandler: ("type",),
    }.get(type(node), ())
    if isinstance(node, ast.JoinedStr | ast.Assert):
        return
    if isinstance(node, Function) and node.name in ("__repr__", "__str__"):
        return
    for name, value in ast.iter_fields(node):
        if name not in skipped:
            values = value if isinstance(value, list) else [value]
            yield from (v for v in values if isinstance(v, ast.AST))


def _expressions(node: ast.expr) -> Iterator[ast.expr]:
    """Yield the changes of one expression, but not of its subexpressions."""
    match node:
        case ast.Compare(ops=[op]):
            yield _with(node, ops=[OPERATORS[type(op)]()])
            if type(op) in BOUNDARIES and _counts(node):
                yield _with(node, ops=[BOUNDARIES[type(op)]()])
        case ast.BoolOp(op=op, values=values):
            yield _with(node, op=OPERATORS[type(op)]())
            for i in range(len(values)):
                rest = values[:i] + values[i + 1 :]
                yield rest[0] if len(rest) == 1 else _with(node, values=rest)
        case ast.BinOp(op=op) if type(op) in OPERATORS and not _is_text(node):
            yield _with(node, op=OPERATORS[type(op)]())
        case ast.UnaryOp(op=ast.USub() | ast.Not() | ast.Invert(), operand=operand):
            yield operand
        case ast.IfExp(test=test):
            yield _with(node, test=ast.UnaryOp(ast.Not(), test))
        case ast.Constant(value=value):
            yield from _other_values(value)
        case ast.Call():
            yield from _other_calls(node)


def _other_values(value: object) -> Iterator[ast.expr]:
    match value:
        case bool():
            yield ast.Constant(not value)
        case int():
            yield ast.Constant(value + 1)
        case float():
            yield ast.Constant(2 * value if value else 1.0)


def _other_calls(node: ast.Call) -> Iterator[ast.expr]:
    match node.func:
        case ast.Name(id=name):
            other: ast.expr = ast.Name(FUNCTIONS.get(name, name))
        case ast.Attribute(value=of, attr=name):
            other = ast.Attribute(of, FUNCTIONS.get(name, name))
        case _:
            return
    if name in FUNCTIONS:
        yield _with(node, func=other)
    if name in DROPPED and len(node.args) == 1:
        yield node.args[0]


def _with(node: ast.expr, **fields: object) -> ast.expr:
    new = deepcopy(node)
    for name, value in fields.items():
        setattr(new, name, value)
    return new


def _counts(node: ast.Compare) -> bool:
    return any(
        (isinstance(n, ast.Constant) and isinstance(n.value, int))
        or getattr(n, "id", getattr(n, "attr", None)) in COUNTS
        for n in ast.walk(node)
    )


def _is_text(node: ast.AST) -> bool:
    return any(
        isinstance(n, ast.JoinedStr)
        or (isinstance(n, ast.Constant) and isinstance(n.value, str))
        for n in ast.walk(node)
    )


def _is_removable(node: ast.stmt, parent: ast.AST) -> bool:
    """Return True if a statement is a guard or does more than bind a name."""
    match node:
        case ast.Expr(value=ast.Constant()):
            return False  # a docstring
        case ast.Expr() | ast.AugAssign() | ast.Raise() | ast.Continue() | ast.Break():
            return True
        case ast.Assign(targets=[ast.Attribute() | ast.Subscript()]):
            return True
        case ast.Return():
            return isinstance(parent, ast.If)
        case _:
            return False


# ---- running


class Laboratory:
    """Copy of the project with a process on one CPU that forks for each mutant.

    The process has imported `LIBRARIES`, which takes longer than most tests, but no
    module of the project.
    """

    def __init__(self, folder: Path, cpu: int) -> None:
        self.folder = folder
        context = get_context("spawn")
        self._pipe, there = context.Pipe()
        self._process = context.Process(target=_serve, args=(there, folder, cpu))
        self._process.start()
        there.close()

    def close(self) -> None:
        """End the process."""
        self._pipe.close()
        self._process.join()

    def failure(self, tests: Sequence[str], limit: float = inf) -> str | None:
        """Run tests; return a description of the first failure, or None without one.

        limit : time limit in s
        """
        self._pipe.send((tests, limit))
        return cast(str | None, self._pipe.recv())

    def failure_on(
        self, mutant: Mutant, tests: Sequence[str], limit: float
    ) -> str | None:
        """Run tests on a mutant, as in `failure`, and restore the module afterwards."""
        path = self.folder / mutant.module
        original = path.read_bytes()
        try:
            self._write(path, mutant.source)
            return self.failure(tests, limit)
        finally:
            self._write(path, original)

    def _write(self, path: Path, source: bytes) -> None:
        """Write a module and delete its bytecode."""
        # Python checks only whether the size and the time (in s) of a source equal the
        # values in the bytecode, and both may be equal for two mutants.
        path.write_bytes(source)
        for compiled in (path.parent / "__pycache__").glob(f"{path.stem}.*.pyc"):
            compiled.unlink()


def _serve(pipe: Connection, folder: Path, cpu: int) -> None:
    """Run the tests requested through the pipe, each time in a fork of this process."""
    os.sched_setaffinity(0, {cpu})
    os.chdir(folder)
    os.environ["PYTHONPATH"] = sys.path[0] = str(folder)
    for library in LIBRARIES:
        import_module(library)
    spec = find_spec("mortarbench.harness")
    assert spec is not None
    assert spec.origin is not None
    assert Path(spec.origin).is_relative_to(folder), f"{spec.origin} is not a copy"
    while True:
        try:
            tests, limit = pipe.recv()
        except EOFError:
            return
        output = folder / "output.txt"
        if (child := os.fork()) == 0:
            _run_tests(tests, output)
        code = _wait(child, limit)
        lines = output.read_text(errors="replace").strip().splitlines()
        failures = [s for s in lines if s.startswith(("FAILED", "ERROR"))]
        if code is None:
            pipe.send(f"hangs ({limit:.0f} s)")
        elif code == 0:
            pipe.send(None)
        else:  # a negative code is the number of a signal
            message = "; ".join([f"exit code {code}", *lines[-1:]])
            pipe.send((failures or [message])[0])


def _run_tests(tests: Sequence[str], output: Path) -> None:
    """Run tests in this process and exit."""
    os.setsid()
    fd = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(fd, 1)
    os.dup2(fd, 2)
    code = 3
    try:
        options = ["-x", "-q", "--no-header", "--tb=no", "--hypothesis-seed=0"]
        plugins = ["-p", "no:cacheprovider", "-p", "no:xdist"]
        # pytest would warn that it cannot rewrite assertions of the imported LIBRARIES
        warnings = ["-W", "ignore::pytest.PytestAssertRewriteWarning"]
        code = int(pytest.main([*options, *plugins, *warnings, *tests]))
    finally:
        sys.stdout.flush()
        os._exit(code)


def _wait(child: int, limit: float) -> int | None:
    """Wait for a fork; return its exit code, or None if it exceeded the limit.

    If the limit is exceeded, all processes of the session of the fork are killed.

    limit : s
    """
    end = monotonic() + limit
    while monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        sleep(0.02)
    os.killpg(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def copy_of_the_project(folder: Path) -> None:
    """Copy the compiled modules and all other files that git does not ignore."""
    command = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listed = subprocess.run(command, cwd=ROOT, check=True, capture_output=True)
    paths = [ROOT / name for name in os.fsdecode(listed.stdout).split("\0") if name]
    compiled = [
        library
        for path in paths if path.suffix == ".pyx"
        for library in path.parent.glob(f"{path.stem}.*.so")
    ]  # fmt: skip
    for path in paths + compiled:
        if not path.is_file() and not path.is_symlink():
            continue
        copy = folder / path.relative_to(ROOT)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(path, copy, follow_symlinks=False)


def read_plan() -> Plan:
    """Read `tests/mutants.toml`."""
    table = tomllib.loads(PLAN.read_text("utf-8"))
    accepted = {
        (module, entry["where"], entry["mutant"]): entry["reason"]
        for module, entries in table.get("survivors", {}).items()
        for entry in entries
    }
    return Plan(table["most"], table["modules"], accepted)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the mutants of all requested modules; return the exit code.

    The code is 0 if all are killed or accepted, 1 if another mutant survives, and 2 if
    the input is invalid or tests of an unchanged module fail.
    """
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument(
        "modules", nargs="*", help="modules of tests/mutants.toml; default: all"
    )
    parser.add_argument("--most", type=int, help="largest number of mutants per module")
    args = parser.parse_args(argv)
    plan = read_plan()
    modules = args.modules or list(plan.tests)
    for module in modules:
        if module not in plan.tests or not (ROOT / module).is_file():
            print(f"{module}: not a module of tests/mutants.toml", file=sys.stderr)
            return 2
    with TemporaryDirectory(prefix="mortarbench-mutants-") as scratch:
        laboratories = []
        for cpu in sorted(os.sched_getaffinity(0)):
            folder = Path(scratch) / str(cpu)
            copy_of_the_project(folder)
            laboratories.append(Laboratory(folder, cpu))
        try:
            with ThreadPoolExecutor(len(laboratories)) as pool:
                codes = [
                    report(plan, m, args.most or plan.most, laboratories, pool)
                    for m in modules
                ]
        finally:
            for laboratory in laboratories:
                laboratory.close()
    return max(codes)


def report(
    plan: Plan,
    module: str,
    most: int,
    laboratories: Sequence[Laboratory],
    pool: ThreadPoolExecutor,
) -> int:
    """Run the mutants of one module and print survivors; return a code as in `main`.

    most : largest number of mutants
    """
    start = monotonic()
    tests = plan.tests[module]
    # run the tests on each unchanged copy to measure the usual time and to fill caches
    for failure in pool.map(lambda one: one.failure(tests), laboratories):
        if failure is not None:
            print(f"{module}: the tests of the unchanged module fail: {failure}")
            return 2
    limit = GRACE + SLOWER * (monotonic() - start)
    every = mutants_of(module, (ROOT / module).read_bytes())
    chosen = sorted(every, key=lambda m: m.rank)[:most]
    free: SimpleQueue[Laboratory] = SimpleQueue()
    for laboratory in laboratories:
        free.put(laboratory)

    def survives(mutant: Mutant) -> bool:
        laboratory = free.get()
        try:
            return laboratory.failure_on(mutant, tests, limit) is None
        finally:
            free.put(laboratory)

    flags = pool.map(survives, chosen)
    survivors = [m for m, flag in zip(chosen, flags, strict=True) if flag]
    new = [m for m in survivors if m.key not in plan.accepted]
    print(
        f"{module}: {len(chosen) - len(survivors)} of {len(chosen)} killed "
        f"(of {len(every)} possible), {len(survivors) - len(new)} accepted, "
        f"{len(new)} not; {monotonic() - start:.0f} s"
    )
    for m in sorted(new, key=lambda m: m.line):
        print(f"  survives: line {m.line}, {m.where or 'module'}: {m.change}")
    killed = {m.key for m in chosen} - {m.key for m in survivors}
    for _, where, change in sorted(plan.accepted.keys() & killed):
        print(f"  accepted, but killed: {where}: {change}")
    sys.stdout.flush()
    return int(bool(new))


if __name__ == "__main__":
    sys.exit(main())
