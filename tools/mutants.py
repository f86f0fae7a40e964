"""Break chosen modules in small ways and see whether their tests notice.

A mutant is a copy of the project with one expression or statement changed: a sign, a
comparison, a constant, a guard left out. The tests of the mutated module run on it. If
one of them fails, the mutant is killed; if all pass, it survives, and nothing
protects that line. `tests/mutants.toml` names the modules, their tests, how many
mutants of each are tried, and which survivors are accepted, with a reason each. Any
other survivor makes the exit code 1.

Which mutants are tried depends on their text alone, so that a change in one function
leaves the choice in others. The working tree is never touched.

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
SLOWER, GRACE = 5.0, 20.0  #: a mutant hangs after that many times the usual, plus s
SHOWN = 100  #: characters of code in a description
#: imported once, not for each mutant
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
#: tried where a side counts something: between floats the boundary seldom matters
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
DROPPED = ("abs", "sqrt", "sorted")  #: calls that leave their argument
COUNTS = ("len", "size", "sum", "shape")

Function = ast.FunctionDef | ast.AsyncFunctionDef


@dataclass(frozen=True)
class Mutant:
    """One change of one module."""

    module: str  #: path from the root
    where: str  #: function or class, dotted; "" for the module's own level
    change: str  #: ``old -> new``, with a number where a place has several such
    line: int
    source: bytes  #: of the whole module, changed

    @property
    def key(self) -> tuple[str, str, str]:
        """What a survivor is listed by; line numbers would not last."""
        return self.module, self.where, self.change

    @property
    def rank(self) -> bytes:
        """A random number that depends on nothing but the mutant."""
        return hashlib.sha256("\0".join(self.key).encode()).digest()


@dataclass(frozen=True)
class Plan:
    """What `tests/mutants.toml` says."""

    most: int  #: mutants per module
    tests: dict[str, list[str]]  #: arguments of pytest by module
    accepted: dict[tuple[str, str, str], str]  #: reasons of survivors, by key


# ---- mutating


def mutants_of(module: str, source: bytes) -> list[Mutant]:
    """Make all mutants of a module, in the order of its text."""
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))
    seen: Counter[tuple[str, str]] = Counter()
    found = []
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
        found.append(Mutant(module, where, text, node.lineno, changed))
    return found


def _shown(code: str) -> str:
    one_line = " ".join(code.split())
    return one_line if len(one_line) <= SHOWN else one_line[: SHOWN - 1] + "…"


def _changes(
    tree: ast.AST, where: str = ""
) -> Iterator[tuple[str, ast.expr | ast.stmt, str]]:
    """Walk through what has a meaning for results: no texts, types or messages."""
    for child in _children(tree):
        name = where
        if isinstance(child, Function | ast.ClassDef):
            name = f"{where}.{child.name}".lstrip(".")
        if isinstance(child, ast.expr) and isinstance(
            getattr(child, "ctx", ast.Load()), ast.Load
        ):
            for new in _expressions(child):
                yield where, child, f"({ast.unparse(new)})"
        if isinstance(child, ast.stmt) and _can_go(child, tree):
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
    """Make the changes of one expression, not of its parts."""
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


def _can_go(node: ast.stmt, parent: ast.AST) -> bool:
    """Whether a statement is left out: what acts on something, or guards."""
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
    """A copy of the project, a CPU, and a process that forks for each mutant.

    That process has imported the libraries, which takes longer than most tests, but
    nothing of the project.
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

    def noticed(self, tests: Sequence[str], limit: float = inf) -> str | None:
        """Run tests: None if all pass, else what noticed."""
        self._pipe.send((tests, limit))
        return cast(str | None, self._pipe.recv())

    def tried(self, mutant: Mutant, tests: Sequence[str], limit: float) -> str | None:
        """Run tests on a mutant, and mend the copy again."""
        path = self.folder / mutant.module
        intact = path.read_bytes()
        try:
            self._write(path, mutant.source)
            return self.noticed(tests, limit)
        finally:
            self._write(path, intact)

    def _write(self, path: Path, source: bytes) -> None:
        """Write a module and forget its bytecode, which is told by size and second."""
        path.write_bytes(source)
        for compiled in (path.parent / "__pycache__").glob(f"{path.stem}.*.pyc"):
            compiled.unlink()


def _serve(pipe: Connection, folder: Path, cpu: int) -> None:
    """Run the tests that the pipe asks for, each time in a fork of this process."""
    os.sched_setaffinity(0, {cpu})
    os.chdir(folder)
    os.environ["PYTHONPATH"] = sys.path[0] = str(folder)
    for library in LIBRARIES:
        import_module(library)
    spec = find_spec("mortarbench.harness")
    assert spec is not None
    assert spec.origin is not None
    assert Path(spec.origin).is_relative_to(folder), f"{spec.origin} is no copy"
    while True:
        try:
            tests, limit = pipe.recv()
        except EOFError:
            return
        output = folder / "output.txt"
        if (child := os.fork()) == 0:
            _run_tests(tests, output)
        code = _waited(child, limit)
        lines = output.read_text(errors="replace").strip().splitlines()
        named = [s for s in lines if s.startswith(("FAILED", "ERROR"))]
        if code is None:
            pipe.send(f"hangs ({limit:.0f} s)")
        elif code == 0:
            pipe.send(None)
        else:  # below zero: by that signal
            said = "; ".join([f"exit code {code}", *lines[-1:]])
            pipe.send((named or [said])[0])


def _run_tests(tests: Sequence[str], output: Path) -> None:
    """Be a process that runs tests; never returns."""
    os.setsid()
    fd = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(fd, 1)
    os.dup2(fd, 2)
    code = 3
    try:
        options = ["-x", "-q", "--no-header", "--tb=no", "--hypothesis-seed=0"]
        plugins = ["-p", "no:cacheprovider", "-p", "no:xdist"]
        early = ["-W", "ignore::pytest.PytestAssertRewriteWarning"]  # LIBRARIES are
        code = int(pytest.main([*options, *plugins, *early, *tests]))
    finally:
        sys.stdout.flush()
        os._exit(code)


def _waited(child: int, limit: float) -> int | None:
    """Wait for a fork that leads a session: its exit code, None if that took longer."""
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
    """Copy what git knows of, as it is in the working tree, and compiled modules."""
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
    """Try the mutants; returns 1 if one survives that is not listed, 2 on bad input."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("modules", nargs="*", help="as in tests/mutants.toml; all")
    parser.add_argument("--most", type=int, help="mutants per module")
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
                found = [
                    report(plan, m, args.most or plan.most, laboratories, pool)
                    for m in modules
                ]
        finally:
            for laboratory in laboratories:
                laboratory.close()
    return max(found)


def report(
    plan: Plan,
    module: str,
    most: int,
    laboratories: Sequence[Laboratory],
    pool: ThreadPoolExecutor,
) -> int:
    """Try the mutants of one module and say which survive; returns as `main` does."""
    start = monotonic()
    tests = plan.tests[module]
    # unchanged, on each copy: for the time that it takes, and to fill caches
    for failure in pool.map(lambda one: one.noticed(tests), laboratories):
        if failure is not None:
            print(f"{module}: its tests fail unchanged: {failure}")
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
            return laboratory.tried(mutant, tests, limit) is None
        finally:
            free.put(laboratory)

    alive = [m for m, s in zip(chosen, pool.map(survives, chosen), strict=True) if s]
    new = [m for m in alive if m.key not in plan.accepted]
    print(
        f"{module}: {len(chosen) - len(alive)} of {len(chosen)} killed "
        f"(of {len(every)} possible), {len(alive) - len(new)} accepted, "
        f"{len(new)} not; {monotonic() - start:.0f} s"
    )
    for m in sorted(new, key=lambda m: m.line):
        print(f"  survives: line {m.line}, {m.where or 'module'}: {m.change}")
    killed = plan.accepted.keys() & ({m.key for m in chosen} - {m.key for m in alive})
    for _, where, change in sorted(killed):
        print(f"  accepted, but killed: {where}: {change}")
    sys.stdout.flush()
    return int(bool(new))


if __name__ == "__main__":
    sys.exit(main())
