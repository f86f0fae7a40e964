"""Registries of solvers and families, and plug-ins from files and packages.

A registry maps names to solvers or families. In a registry of solvers, the entry
``"PREFIX:*"`` represents all backends of a generic adapter. In the name
``PREFIX:BACKEND``, the text after the last colon is the value of the adapter's field
``backend``. An adapter may have a method ``backends()``, which returns the names of the
installed backends.

While a plug-in file is loaded, its folder is the first entry of `sys.path`, as for a
script; afterwards it is the last one, for imports in calls. The modules beside the file
that were imported are then forgotten, so that two plug-ins may have different modules
with the same name.
"""

from __future__ import annotations

import importlib.util
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass, field, fields, is_dataclass, replace
from importlib import import_module
from pathlib import Path
from types import ModuleType, NoneType, UnionType
from typing import (
    TYPE_CHECKING,
    Any,
    Literal,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

import msgspec

from mortarbench.harness.checked import located
from mortarbench.harness.digest import hex_digest, pieces
from mortarbench.harness.errors import PLUGINS, InputError, described, shown, unknown
from mortarbench.harness.keys import keys_of
from mortarbench.harness.plugin import Family, Solver

if TYPE_CHECKING:
    from mortarbench.harness.operators import Maker

T = TypeVar("T")

_SOLVER_PARTS = ("declines", "prepare")
#: types of an option whose default is None and that has no annotation; an integer is
#: not read as a float, and 1 is not read as true
_ANY = (int, float, bool, str, NoneType)
#: types in messages, by the names that Python or msgspec use
_WORDS = {
    "int": "an integer",
    "float": "a number",
    "bool": "true or false",
    "str": "a string",
    "NoneType": "none",
    "null": "none",
    "array": "a list",
    "object": "a table",
}
_LABELLED = re.compile(r"([\w.-]+)=(.+)", re.DOTALL)


@dataclass(frozen=True, kw_only=True)
class SolverSpec:
    """A solver in a suite: name, label, options, role and number of ranks."""

    name: str  #: name in the registry, "NAME" or "PREFIX:BACKEND"
    label: str  #: label in records and reports
    #: options that the suite sets, by name
    options: Mapping[str, Any] = field(default_factory=dict)
    #: "" for an ordinary solver; "null" for the second copy of a solver in an A/A
    #: comparison, which measures the noise
    role: str = ""
    ranks: int = 1  #: number of MPI processes

    def on(self, ranks: int) -> SolverSpec:
        """Return the same solver on `ranks` MPI processes; the label states `ranks`."""
        if ranks == 1:
            return self
        return replace(self, ranks=ranks, label=f"{self.label} ranks={ranks}")


@dataclass(frozen=True)
class PluginFile:
    """A plug-in file, written ``FILE.py`` or ``LABEL=FILE.py``.

    With a label, the solvers of the file are named ``LABEL:NAME``, so that two versions
    of a plug-in can be measured in one run. The names of families do not change.

    >>> from mortarbench.harness.registry import PluginFile
    >>> PluginFile.of("new=mine.py")
    PluginFile(path=PosixPath('mine.py'), label='new')
    """

    path: Path
    label: str = ""

    @classmethod
    def of(cls, text: str | Path | PluginFile) -> PluginFile:
        """Parse ``[LABEL=]FILE.py``; in a path, a ``/`` must precede any ``=``."""
        if isinstance(text, PluginFile):
            return text
        if isinstance(text, str) and (match := _LABELLED.fullmatch(text)):
            return cls(Path(match[2]), match[1])
        return cls(Path(text))

    def __str__(self) -> str:
        return f"{self.label}={self.path}" if self.label else str(self.path)

    @property
    def name(self) -> str:
        """The label, if any, and the name of the file without its folder."""
        return str(replace(self, path=Path(self.path.name)))

    def resolved(self) -> PluginFile:
        """Return the same plug-in file with an absolute path."""
        return replace(self, path=self.path.resolve())

    def content(self) -> Iterator[bytes]:
        """Yield the bytes of the file, then paths and bytes of modules beside it.

        The modules are those that the file imports, directly or indirectly, sorted by
        path. Import statements inside functions count.

        Raises
        ------
        InputError
            If the file does not exist.

        """
        from modulefinder import ModuleFinder

        path = self.path.resolve()
        if not path.is_file():
            raise _no_file(self)
        finder = ModuleFinder([str(path.parent)])
        with suppress(SyntaxError, ValueError, RecursionError):  # reported by a load
            finder.run_script(str(path))
        found = (getattr(m, "__file__", None) for m in finder.modules.values())
        files = {Path(file) for file in found if file}
        for file in (path, *sorted(files - {path})):
            if file != path:
                yield f"\0{file.relative_to(path.parent)}\0".encode()
            with file.open("rb") as code:
                yield from pieces(code)


@dataclass(frozen=True, kw_only=True)
class Plugin:
    """Solvers, families and operators that a plug-in adds to the registries."""

    solvers: Mapping[str, Solver] = field(default_factory=dict)
    problems: Mapping[str, Family] = field(default_factory=dict)
    #: functions that build operators, by name; see `harness.operators`
    operators: Mapping[str, Maker] = field(default_factory=dict)
    origin: str = ""  #: path of the plug-in file, or "entry points"


class Registry(Mapping[str, T]):
    """Mapping of names to objects; "MODULE:NAME" is imported on first access.

    If NAME is a class, it is instantiated. Entry points of installed packages are read
    when a name is not among the other entries, or when all names are listed.

    >>> from mortarbench.harness.registry import Registry
    >>> registry = Registry({"half": "fractions:Fraction"})
    >>> list(registry)  # nothing is imported yet
    ['half']
    >>> registry["half"]
    Fraction(0, 1)
    """

    def __init__(
        self,
        entries: Mapping[str, str | T],
        check: Callable[[object], None] = lambda _: None,
        group: str = "",
    ) -> None:
        """Store the entries.

        check : function that raises `InputError` if an imported object has a wrong type
        group : group of entry points of installed packages; "" for none
        """
        self._entries = dict(entries)
        self._group = group
        self.check = check

    @property
    def entries(self) -> dict[str, str | T]:
        """All entries by name, including those of installed packages."""
        if self._group:
            new = entry_points_of(self._group)
            _refuse_taken(self._group.rpartition(".")[2][:-1], self._entries, new)
            self._entries |= new
            self._group = ""
        return self._entries

    def __getitem__(self, name: str) -> T:
        entries = self._entries if name in self._entries else self.entries
        if not isinstance(entry := entries[name], str):
            return entry
        module, _, attribute = entry.partition(":")
        try:
            with redirect_stdout(sys.stderr):
                thing = getattr(import_module(module), attribute)
        except Exception as e:  # raised by code of an installed package
            raise _import_error(entry, e) from None
        if isinstance(thing, type):
            thing = thing()
        with located(f"{entry}, registered as {name!r}"):
            self.check(thing)
        entries[name] = thing
        return thing  # type: ignore[no-any-return]

    def __contains__(self, name: object) -> bool:
        return name in self._entries or name in self.entries

    def __iter__(self) -> Iterator[str]:
        return iter(self.entries)

    def __len__(self) -> int:
        return len(self.entries)


def resolve(spec: SolverSpec, solvers: Mapping[str, Solver]) -> Solver:
    """Return the solver that `spec` names, with its backend and its options.

    Raises
    ------
    InputError
        If the solver, the backend or an option is unknown, or if the value of an option
        has the wrong type or is refused by the solver.

    """
    prefix, colon, backend = spec.name.rpartition(":")
    wildcard = f"{prefix}:*"
    if colon and wildcard in solvers and (backend == "*" or spec.name not in solvers):
        solver = _with_backend(prefix, backend, solvers[wildcard])
        return _with_options(spec, solver, reserved="backend")
    check_name(spec.name, solvers)
    return _with_options(spec, solvers[spec.name])


def check_name(
    name: str, solvers: Mapping[str, Solver], labels: Iterable[str] = ()
) -> None:
    """Check that `name` is the name of a solver, without importing any solver.

    labels : further names that the message suggests

    Raises
    ------
    InputError
        If no solver has this name. Backends of adapters are not checked.

    """
    prefix, colon, _ = name.rpartition(":")
    if name not in solvers and not (colon and f"{prefix}:*" in solvers):
        raise unknown("solver", name, {*labels, *solvers}, more=PLUGINS)


def options_of(solver: Solver) -> dict[str, Any]:
    """Return the values of a solver's options by name; {} if it is not a dataclass.

    The field `settings` of a solver with `library_settings` is a mapping; its items are
    options as well.
    """
    if not is_dataclass(solver):
        return {}
    options = {f.name: getattr(solver, f.name) for f in fields(solver) if f.init}
    return options | (options.pop("settings") if is_adapter(solver) else {})


def known_options(solver: Any, key: str = "") -> dict[str, Any]:
    """Return `options_of` and, with their defaults, the settings of the library.

    key : if a field of the solver has this name, the library is not imported, and its
        settings are omitted
    """
    own = options_of(solver)
    listed = is_adapter(solver) and key not in own and solver.library_settings()
    return {**(listed or {}), **own}


def accepts_any(solver: Any) -> bool:
    """Return True if the library behind a solver does not list its settings."""
    return is_adapter(solver) and solver.library_settings() is None


def is_adapter(solver: object) -> bool:
    """Return True if a solver passes settings to a library, see `Solver`."""
    return hasattr(solver, "library_settings")


def option_value(where: str, value: Any, solver: Solver, key: str) -> Any:
    """Convert a value to the first type of an option that admits it.

    Texts are converted as well, such as "1e-6" to a number.

    Raises
    ------
    InputError
        If no type admits the value.

    """
    kinds = option_types(solver, key)
    is_text = isinstance(value, str)
    if NoneType in kinds and (value is None or (is_text and value == "none")):
        return None
    if kinds is _ANY and not is_text:
        return value
    # scalars of NumPy have an empty shape
    plain = value.item() if getattr(value, "shape", None) == () else value
    for kind in kinds:
        # a TypeError is raised for a class of a plug-in, a UnicodeError for bad texts
        with suppress(msgspec.ValidationError, TypeError, UnicodeError):
            return msgspec.convert(plain, kind, strict=not is_text)
    names: list[str] = []
    for kind in kinds:
        choices = get_args(kind) if get_origin(kind) is Literal else ()
        names += map(str, choices) if choices else [kind.__name__]
    raise InputError(f"{where} = {shown(value)}; expected {in_words(names)}")


def option_types(solver: Solver, key: str) -> tuple[Any, ...]:
    """Return the types of the values of an option; None is one if it is the default.

    An option has its annotated type. The type of the default is used if the annotation
    is missing, Any or object, or if Python cannot evaluate the annotations.
    """
    default = known_options(solver, key).get(key)
    hints: dict[str, Any] = {}
    # code of a plug-in may raise these exceptions
    with suppress(NameError, TypeError, AttributeError, SyntaxError):
        hints = get_type_hints(type(solver))
    kind = hints.get(key, Any) if key in options_of(solver) else Any
    if kind in (Any, object):
        kind = type(default)
    if kind is NoneType:
        return _ANY
    union = get_origin(kind) in (Union, UnionType)
    return (*(get_args(kind) if union else (kind,)), *[NoneType] * (default is None))


def in_words(names: Iterable[str]) -> str:
    """Return the names of types as words for a message.

    >>> from mortarbench.harness.registry import in_words
    >>> in_words(["int", "NoneType"])
    'an integer or none'

    """
    return " or ".join(dict.fromkeys(_WORDS.get(name, name) for name in names))


def load_plugin(file: str | Path | PluginFile) -> Plugin:
    """Import a file that defines ``SOLVERS`` or ``PROBLEMS`` or both.

    If the QPs of its families contain operators, ``OPERATORS`` maps names to the
    functions that build them, see `harness.operators`.

    Raises
    ------
    InputError
        If the file is missing, fails to import, defines neither ``SOLVERS`` nor
        ``PROBLEMS``, or contains an object of the wrong type.

    """
    plugin_file = PluginFile.of(file)
    if not plugin_file.path.is_file():
        raise _no_file(plugin_file)
    with located(str(plugin_file.path)), _importing_from(plugin_file.path.parent):
        module, offered = _imported(plugin_file.path), []
        if not (hasattr(module, "SOLVERS") or hasattr(module, "PROBLEMS")):
            raise InputError("defines neither SOLVERS nor PROBLEMS")
        for name, check in (
            ("SOLVERS", check_solver),
            ("PROBLEMS", check_family),
            ("OPERATORS", _check_callable),
        ):
            things = getattr(module, name, {})
            if not isinstance(things, Mapping):
                raise InputError(f"{name} is of type {_type(things)}; expected dict")
            for key, thing in things.items():
                with located(f"{name}[{key!r}]"):
                    if not isinstance(key, str):
                        raise InputError("the key is not a string; expected a name")
                    check(thing)
            offered.append(dict(things))
    prefix = f"{plugin_file.label}:" if plugin_file.label else ""
    solvers, problems, operators = offered
    return Plugin(
        solvers={f"{prefix}{name}": solver for name, solver in solvers.items()},
        problems=problems,
        operators=operators,
        origin=str(plugin_file.path),
    )


def entry_points_of(group: str) -> dict[str, str]:
    """Return the entry points of installed packages, "MODULE:NAME" by name."""
    from importlib.metadata import entry_points

    return {point.name: point.value for point in entry_points(group=group)}


def merged(what: str, known: Mapping[str, T], new: Mapping[str, Any]) -> Registry[T]:
    """Return a registry with further entries, objects or "MODULE:NAME".

    what : type of the objects, for the message

    Raises
    ------
    InputError
        If both contain the same name, which would make results ambiguous.

    """
    _refuse_taken(what, known, new)
    registry = known if isinstance(known, Registry) else Registry(known)
    return Registry({**registry.entries, **new}, registry.check) if new else registry


def _refuse_taken(what: str, known: Mapping[str, Any], new: Mapping[str, Any]) -> None:
    if both := sorted(known.keys() & new.keys()):
        raise InputError(
            f"{what} {both[0]!r} of the plug-in already exists; rename the new one, or "
            "label the solvers of a plug-in by --plugin LABEL=FILE.py"
        )


@contextmanager
def _importing_from(folder: Path) -> Iterator[None]:
    """Import from a folder first within the block; see the module docstring."""
    place, before = folder.resolve(), set(sys.modules)
    sys.path.insert(0, str(place))
    try:
        with redirect_stdout(sys.stderr):
            yield
    finally:
        sys.path.remove(str(place))
        if str(place) not in sys.path:
            sys.path.append(str(place))
        beside = {entry.name.partition(".")[0] for entry in place.iterdir()}
        beside.discard("mortarbench")  # in the root of a checkout
        for name in set(sys.modules) - before:
            if name.partition(".")[0] in beside:
                del sys.modules[name]


def _imported(path: Path) -> ModuleType:
    """Import a plug-in file under a name that depends on its path."""
    stem = re.sub(r"\W", "_", path.stem)
    name = f"mortarbench_plugin_{stem}_{hex_digest([bytes(path.resolve())])}"
    spec = importlib.util.spec_from_file_location(name, path.resolve())
    if spec is None or spec.loader is None:
        raise InputError("not a Python file; its name must end in .py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look up their module in sys.modules
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as e:  # raised by code of the plug-in
        del sys.modules[name]
        raise _import_error("", e) from None
    return module


def _with_backend(prefix: str, backend: str, solver: Any) -> Solver:
    if backend in ("", "*"):
        raise InputError(f"{prefix}:{backend} names no backend; write {prefix}:NAME")
    backends = getattr(solver, "backends", None)
    if backends is not None and backend not in (known := backends()):
        raise unknown(f"backend of {prefix}", backend, known)
    configured: Solver = replace(solver, backend=backend)
    return configured


def _with_options(spec: SolverSpec, solver: Any, reserved: str = "") -> Solver:
    changes: dict[str, Any] = {}
    settings: dict[str, Any] = {}
    for name, value in spec.options.items():
        known = known_options(solver, name)
        known.pop(reserved, None)
        if name in known:
            value = option_value(f"{spec.name}: {name}", value, solver, name)
        elif name == reserved or not accepts_any(solver):
            raise unknown("option", name, known, where=spec.name)
        own = any(f.name == name for f in fields(solver))
        (changes if own else settings)[name] = value
    if settings:
        changes["settings"] = {**solver.settings, **settings}
    if not changes:
        # without options, the solver need not be a dataclass
        return solver  # type: ignore[no-any-return]
    try:
        configured: Solver = replace(solver, **changes)
    except (TypeError, ValueError) as e:  # raised by the solver's check of its options
        raise InputError(f"{spec.name}: {' '.join(str(e).split())}") from None
    return configured


def check_solver(thing: object) -> None:
    """Check that `thing` is a solver, and not the class of a solver.

    Raises
    ------
    InputError
        If `thing` is something else.

    """
    is_solver = all(hasattr(thing, part) for part in _SOLVER_PARTS)
    if isinstance(thing, type) and is_solver:
        raise InputError(
            f"{thing.__name__} is a class; expected an instance, such as "
            f"{thing.__name__}()"
        )
    if not is_solver:
        raise InputError(
            f"{shown(thing)} is of type {_type(thing)}; expected a solver, an object "
            f"with the methods {' and '.join(_SOLVER_PARTS)}"
        )


def check_family(thing: object) -> None:
    """Check that `thing` is a family with keys, defaults and forms.

    Raises
    ------
    InputError
        If `thing` is something else, or its keys or forms are invalid.

    """
    if not isinstance(thing, Family) or not is_dataclass(thing):
        raise InputError(
            f"of type {_type(thing)}; expected a frozen dataclass that inherits from "
            "mortarbench.Family"
        )
    forms = getattr(thing, "forms", None)
    if not isinstance(forms, tuple) or not forms or {type(f) for f in forms} != {str}:
        raise InputError(f"forms = {shown(forms)}; expected a tuple of strings")
    for name, key in keys_of(type(thing)).items():
        if key.default not in (None, value := getattr(thing, name)):
            raise InputError(
                f"{name} = {value!r}; expected the default of the class, "
                f"{key.default!r}, since case names omit it"
            )


def _check_callable(thing: object) -> None:
    if not callable(thing):
        raise InputError(f"of type {_type(thing)}; expected a function")


def _no_file(plugin_file: PluginFile) -> InputError:
    return InputError(
        f"{plugin_file.path}: no such file; expected a Python file, or LABEL=FILE.py"
    )


def _import_error(where: str, e: BaseException) -> InputError:
    prefix = f"{where}: " if where else ""
    return InputError(f"{prefix}failed to import: {described(e)}")


def _type(thing: object) -> str:
    return type(thing).__name__
