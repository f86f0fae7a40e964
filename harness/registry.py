"""From the name of a solver to a configured solver; plug-ins from files and packages.

A registry is a plain mapping from names to solvers. Its entry ``"PREFIX:*"`` stands for
all backends of one generic adapter: the text after the colon goes into the adapter's
field ``backend``, and ``backends()``, where the adapter has it, lists what is there.
"""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator, Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass, field, fields, is_dataclass, replace
from importlib import import_module
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, TypeVar

from harness.digest import hex_digest
from harness.errors import PLUGINS, InputError, unknown
from harness.plugin import Family, Solver, as_family

if TYPE_CHECKING:
    from harness.operators import Maker

T = TypeVar("T")

_SOLVER_PARTS = ("declines", "prepare")
_FAMILY_PARTS = ("name", "defaults", "forms", "build")


@dataclass(frozen=True, kw_only=True)
class SolverSpec:
    """A solver as a suite asks for it."""

    name: str  #: in the registry, e.g. "NAME" or "PREFIX:BACKEND"
    label: str  #: in records and reports
    options: Mapping[str, Any] = field(
        default_factory=dict
    )  #: that differ from defaults
    role: str = ""  #: "null": one that the suite has already, to show the noise


@dataclass(frozen=True, kw_only=True)
class Plugin:
    """What a plug-in adds to the registries."""

    solvers: Mapping[str, Solver] = field(default_factory=dict)
    problems: Mapping[str, Family] = field(default_factory=dict)
    operators: Mapping[str, Maker] = field(default_factory=dict)  #: `harness.operators`
    origin: str = ""  #: its file, or "entry points"


@dataclass(frozen=True)
class Entry:
    """One line of a registry: where a thing is, and how it is configured."""

    module: str
    attribute: str  #: a class, or an instance
    options: Mapping[str, Any] = field(default_factory=dict)  #: of the class

    def load(self) -> Any:
        """Import the module, and make the instance."""
        found = getattr(import_module(self.module), self.attribute)
        return found(**self.options) if isinstance(found, type) else found


def entry(module: str, attribute: str, **options: Any) -> Entry:
    """Write one line of a registry."""
    return Entry(module, attribute, options)


class Registry(Mapping[str, T]):
    """Things by name, each imported when it is asked for, and once."""

    def __init__(self, entries: Mapping[str, Entry | T]) -> None:
        self.entries = dict(entries)  #: a thing, or where it is
        self._loaded: dict[str, T] = {}

    def __getitem__(self, name: str) -> T:
        if name not in self._loaded:
            found = self.entries[name]
            self._loaded[name] = found.load() if isinstance(found, Entry) else found
        return self._loaded[name]

    def __contains__(self, name: object) -> bool:
        return name in self.entries

    def __iter__(self) -> Iterator[str]:
        return iter(self.entries)

    def __len__(self) -> int:
        return len(self.entries)


def resolve(spec: SolverSpec, solvers: Mapping[str, Solver]) -> Solver:
    """Configure the solver that `spec` asks for.

    Raises
    ------
    InputError
        For an unknown solver, backend or option, and for an option's value that is of
        the wrong type or that the solver refuses.

    """
    prefix, colon, backend = spec.name.partition(":")
    wildcard = f"{prefix}:*"
    if colon and wildcard in solvers and (backend == "*" or spec.name not in solvers):
        solver = _with_options(spec, solvers[wildcard], reserved={"backend"})
        return _with_backend(prefix, backend, solver)
    check_name(spec.name, solvers)
    return _with_options(spec, solvers[spec.name])


def check_name(name: str, solvers: Mapping[str, Solver]) -> None:
    """Refuse a name that no solver has, without loading any.

    Raises
    ------
    InputError
        For an unknown solver. The backends of an adapter are not looked up.

    """
    prefix, colon, _ = name.partition(":")
    if name not in solvers and not (colon and f"{prefix}:*" in solvers):
        raise unknown("solver", name, solvers, more=PLUGINS)


def options_of(solver: Solver) -> dict[str, Any]:
    """Every option of a configured solver with its value; none if it has no fields."""
    if not is_dataclass(solver):
        return {}
    return {f.name: getattr(solver, f.name) for f in fields(solver) if f.init}


def load_plugin(path: Path) -> Plugin:
    """Import a file that defines ``SOLVERS`` and/or ``PROBLEMS``.

    Where families of it make operators, ``OPERATORS`` has what puts them together.

    Raises
    ------
    InputError
        When the file is missing, fails to import, or defines neither or nonsense.

    """
    if not path.is_file():
        raise InputError(f"{path}: no such file; expected a Python file")
    module = _imported(path)
    if not hasattr(module, "SOLVERS") and not hasattr(module, "PROBLEMS"):
        raise InputError(f"{path}: defines neither SOLVERS nor PROBLEMS")
    operators = getattr(module, "OPERATORS", {})
    if not isinstance(operators, Mapping) or not all(
        isinstance(name, str) and callable(make) for name, make in operators.items()
    ):
        raise InputError(f"{path}: OPERATORS is no dict from names to functions")
    found = _checked(
        str(path), getattr(module, "SOLVERS", {}), getattr(module, "PROBLEMS", {})
    )
    return replace(found, operators=dict(operators))


def entry_point_plugins() -> Plugin:
    """Collect what installed packages offer, one solver or family per entry point.

    Raises
    ------
    InputError
        When one fails to import, or is neither a solver nor a family.

    """
    found: dict[str, dict[str, Any]] = {"solvers": {}, "problems": {}}
    for group, entries in found.items():
        for point in entry_points(group=f"mortarbench.{group}"):
            try:
                with redirect_stdout(sys.stderr):
                    entries[point.name] = point.load()
            except Exception as e:  # somebody else's code
                raise _import_error(f"entry point {point.value}", e) from None
    return _checked("entry points", found["solvers"], found["problems"])


def merged(what: str, known: Mapping[str, T], new: Mapping[str, T]) -> Mapping[str, T]:
    """Join two registries.

    Raises
    ------
    InputError
        When both have the same name: which of the two ran would be anybody's guess.

    """
    if both := sorted(known.keys() & new.keys()):
        raise InputError(
            f"{what} {both[0]!r} of the plug-in exists; rename the new one"
        )
    if isinstance(known, Registry):
        return Registry({**known.entries, **new}) if new else known
    return {**known, **new}


def _with_backend(prefix: str, backend: str, solver: Any) -> Solver:
    if backend in ("", "*"):
        raise InputError(f"{prefix}:{backend} names no backend; write {prefix}:NAME")
    backends = getattr(solver, "backends", None)
    if backends is not None and backend not in (known := backends()):
        raise unknown(f"backend of {prefix}", backend, known)
    configured: Solver = replace(solver, backend=backend)
    return configured


def _with_options(
    spec: SolverSpec, solver: Any, *, reserved: set[str] | None = None
) -> Solver:
    known = options_of(solver)
    for name in reserved or ():
        known.pop(name, None)
    changes = {}
    for name, value in spec.options.items():
        if name not in known:
            raise unknown("option", name, known, where=spec.name)
        changes[name] = _option(f"{spec.name}: {name}", value, known[name])
    if not changes:
        return solver  # type: ignore[no-any-return]  # need not even be a dataclass
    try:
        configured: Solver = replace(solver, **changes)
    except (TypeError, ValueError) as e:  # the solver's own check of its options
        raise InputError(f"{spec.name}: {_one_line(e)}") from None
    return configured


def _option(where: str, value: Any, current: Any) -> Any:
    """Check the type of an option's value by that of the value it replaces."""
    match current, value:
        case None, _:
            return value
        case bool(), bool():
            return value
        case float(), int() | float() if not isinstance(value, bool):
            return float(value)
        case Mapping(), Mapping():
            return value
        case (bool(), _) | (_, bool()):
            pass
        case _ if isinstance(value, type(current)):
            return value
    expected, got = type(current).__name__, type(value).__name__
    raise InputError(f"{where} = {value!r} is of type {got}; expected {expected}")


def _imported(path: Path) -> ModuleType:
    """Import by path under a name of its own; dataclasses need it in sys.modules."""
    name = f"plugin_{path.stem}_{hex_digest([bytes(path.resolve())])}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise InputError(f"{path}: no Python file; its name must end in .py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        with redirect_stdout(sys.stderr):
            spec.loader.exec_module(module)
    except (Exception, SystemExit) as e:  # somebody else's code
        del sys.modules[name]
        raise _import_error(str(path), e) from None
    return module


def _checked(where: str, solvers: Any, problems: Any) -> Plugin:
    """Check what a plug-in offers before anything is run with it."""
    for name, offered, kind, parts in (
        ("SOLVERS", solvers, "solver", _SOLVER_PARTS),
        ("PROBLEMS", problems, "family", _FAMILY_PARTS),
    ):
        if not isinstance(offered, Mapping):
            raise InputError(
                f"{where}: {name} is of type {_type(offered)}; expected dict"
            )
        for key, thing in offered.items():
            if isinstance(thing, type):
                raise InputError(
                    f"{where}: {name}[{key!r}] is a class; expected an instance"
                )
            lacking = [part for part in parts if not hasattr(thing, part)]
            if not isinstance(key, str) or lacking:
                raise InputError(
                    f"{where}: {name}[{key!r}] is of type {_type(thing)}; "
                    f"expected a {kind}, under a name, with {', '.join(parts)}"
                )
    for key, family in problems.items():
        if family.name != key:
            raise InputError(
                f"{where}: PROBLEMS[{key!r}] is named {family.name!r}; "
                "expected the same name twice"
            )
        _check_names(f"{where}: PROBLEMS[{key!r}]", family)
    families = {name: as_family(offered) for name, offered in problems.items()}
    return Plugin(solvers=dict(solvers), problems=families, origin=where)


def _check_names(where: str, family: Any) -> None:
    """Refuse a family whose case names could not be read or written."""
    defaults, forms = family.defaults, family.forms
    if not isinstance(defaults, Mapping) or not all(
        isinstance(key, str) and type(value) in (int, float, str)
        for key, value in defaults.items()
    ):
        raise InputError(
            f"{where}: defaults = {defaults!r}; "
            "expected a dict from texts to integers, floats or texts"
        )
    if (
        not isinstance(forms, tuple | list)
        or not forms
        or not all(isinstance(form, str) and form for form in forms)
    ):
        raise InputError(f"{where}: forms = {forms!r}; expected a tuple of texts")


def _import_error(where: str, e: BaseException) -> InputError:
    return InputError(f"{where}: failed to import: {_type(e)}: {_one_line(e)}")


def _type(thing: object) -> str:
    return type(thing).__name__


def _one_line(e: BaseException) -> str:
    return " ".join(str(e).split())
