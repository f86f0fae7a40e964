"""Registries of solvers and families, and plug-ins from files and packages.

A registry maps names to solvers or families. In a registry of solvers, the entry
``"PREFIX:*"`` represents all backends of a generic adapter. In the name
``PREFIX:BACKEND``, the text after the last colon is the value of the adapter's field
``backend``. An adapter may have a method ``backends()``, which returns the names of the
installed backends.

A plug-in file is loaded as a separate Python package, whose path is the folder of the
file. The plug-in can import the modules and packages in this folder, which are called
its neighbours. Two plug-ins may have different neighbours with the same name. When the
code of a plug-in is compiled, ``import helper`` is therefore replaced by an import of
the submodule ``helper`` of its package. Similarly, ``from harness import QP`` is
replaced by an import from `mortarbench.harness`.
"""

from __future__ import annotations

import ast
import importlib
import importlib.util
import os
import re
import sys
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import dataclass, field, fields, is_dataclass, replace
from functools import partial
from importlib import import_module
from importlib.machinery import (
    EXTENSION_SUFFIXES,
    SOURCE_SUFFIXES,
    ExtensionFileLoader,
    FileFinder,
    ModuleSpec,
    PathFinder,
    SourceFileLoader,
)
from pathlib import Path
from types import CodeType, ModuleType, NoneType
from typing import (
    TYPE_CHECKING,
    Any,
    TypeVar,
    get_type_hints,
)

from mortarbench.harness.checked import located
from mortarbench.harness.digest import hex_digest, pieces
from mortarbench.harness.errors import PLUGINS, InputError, shown, unknown
from mortarbench.harness.keys import classes_of, keys_of
from mortarbench.harness.plugin import Family, Solver

if TYPE_CHECKING:
    from mortarbench.harness.operators import Maker

T = TypeVar("T")

_SOLVER_PARTS = ("declines", "prepare")
_LABELLED = re.compile(r"([\w.-]+)=(.+)", re.DOTALL)
#: Names of modules that a plug-in does not import from its folder, even if they exist
#: there.
_NEVER_BESIDE = sys.stdlib_module_names | {"harness", "mortarbench"}
#: Subpackages that old plug-ins import without the prefix ``mortarbench.``.
_ROOMS = ("harness", "problems", "solvers", "reports")
#: Prefix of the folder in the ``__path__`` of a plug-in's package. A hook in
#: `sys.path_hooks` recognises entries by this prefix.
_BESIDE = "beside a plug-in: "


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
        """Yield the bytes of the file, then paths and bytes of imported neighbours.

        Neighbours are the modules in the same folder that the file imports, directly or
        through other neighbours, and all modules of packages there that it imports;
        they are sorted by path. Import statements inside functions count.

        Raises
        ------
        InputError
            If the file does not exist.

        """
        path = self.path.resolve()
        if not path.is_file():
            raise _no_file(self)
        for file in (path, *sorted(_neighbours(path))):
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


@dataclass(frozen=True)
class Entry:
    """Reference to an object of a registry, which `load` imports."""

    module: str
    attribute: str  #: name of a class or an instance in the module
    options: Mapping[str, Any] = field(default_factory=dict)  #: arguments of the class

    def load(self) -> Any:
        """Import the module, and return the object; a class is instantiated."""
        thing = getattr(import_module(self.module), self.attribute)
        return thing(**self.options) if isinstance(thing, type) else thing


def entry(module: str, attribute: str, **options: Any) -> Entry:
    """Return the entry of a registry that refers to an attribute of a module.

    >>> from mortarbench.harness.registry import Registry, entry
    >>> registry = Registry({"half": entry("fractions", "Fraction", numerator="1/2")})
    >>> list(registry)  # nothing is imported yet
    ['half']
    >>> registry["half"]
    Fraction(1, 2)
    """
    return Entry(module, attribute, options)


class Registry(Mapping[str, T]):
    """Mapping of names to objects, each imported on first access."""

    def __init__(self, entries: Mapping[str, Entry | T]) -> None:
        self.entries = dict(entries)  #: objects, or references to objects, by name
        self._loaded: dict[str, T] = {}

    def __getitem__(self, name: str) -> T:
        if name not in self._loaded:
            thing = self.entries[name]
            self._loaded[name] = thing.load() if isinstance(thing, Entry) else thing
        return self._loaded[name]

    def __contains__(self, name: object) -> bool:
        return name in self.entries

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
        return _with_options(spec, solver, reserved={"backend"})
    check_name(spec.name, solvers)
    return _with_options(spec, solvers[spec.name])


def check_name(name: str, solvers: Mapping[str, Solver]) -> None:
    """Check that `name` is the name of a solver, without importing any solver.

    Raises
    ------
    InputError
        If no solver has this name. Backends of adapters are not checked.

    """
    prefix, colon, _ = name.rpartition(":")
    if name not in solvers and not (colon and f"{prefix}:*" in solvers):
        raise unknown("solver", name, solvers, more=PLUGINS)


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


def option_types(solver: Solver) -> dict[str, Any]:
    """Return the annotated types of a solver's options by name.

    Options annotated as Any or object are omitted. If Python cannot evaluate the
    annotations, all options are omitted. An omitted option has the type of its default.
    """
    try:
        hints = get_type_hints(type(solver))
    except (NameError, TypeError, AttributeError, SyntaxError):  # code of a plug-in
        return {}
    return {
        name: hints[name]
        for name in options_of(solver)
        if name in hints and hints[name] not in (Any, object)
    }


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
    module = _imported(plugin_file.path)
    if not hasattr(module, "SOLVERS") and not hasattr(module, "PROBLEMS"):
        raise InputError(f"{plugin_file.path}: defines neither SOLVERS nor PROBLEMS")
    operators = getattr(module, "OPERATORS", {})
    if not isinstance(operators, Mapping) or not all(
        isinstance(name, str) and callable(make) for name, make in operators.items()
    ):
        raise InputError(
            f"{plugin_file.path}: OPERATORS is not a dict from names to functions"
        )
    found = _checked(
        str(plugin_file.path),
        getattr(module, "SOLVERS", {}),
        getattr(module, "PROBLEMS", {}),
    )
    prefix = f"{plugin_file.label}:" if plugin_file.label else ""
    solvers = {f"{prefix}{name}": solver for name, solver in found.solvers.items()}
    return replace(found, solvers=solvers, operators=dict(operators))


def entry_point_plugins() -> Plugin:
    """Import the solvers and families of installed packages, one per entry point.

    Raises
    ------
    InputError
        If an entry point fails to import, or is not a solver or a family.

    """
    found: dict[str, dict[str, Any]] = {"solvers": {}, "problems": {}}
    if not _some_package_offers():
        return Plugin(origin="entry points")
    # imported here, since this module loads slowly and is seldom needed
    from importlib.metadata import entry_points

    for group, entries in found.items():
        for point in entry_points(group=f"mortarbench.{group}"):
            try:
                with redirect_stdout(sys.stderr), _standing_for_harness():
                    entries[point.name] = point.load()
            except Exception as e:  # raised by code of the package
                raise _import_error(f"entry point {point.value}", e) from None
    return _checked("entry points", found["solvers"], found["problems"])


def _some_package_offers() -> bool:
    """Return True if an installed package may declare entry points for mortarbench.

    The function reads the folders of `sys.path`, which is faster than importing
    importlib.metadata. The function does not open archives; if an archive is on the
    path, the result is True.
    """
    for place in sys.path:
        if os.path.isfile(place):
            return True
        with suppress(OSError), os.scandir(place or ".") as folders:
            for folder in folders:
                if folder.name.endswith((".dist-info", ".egg-info", "EGG-INFO")):
                    file = Path(folder.path, "entry_points.txt")
                    if file.is_file() and b"[mortarbench." in file.read_bytes():
                        return True
    return False


def merged(what: str, known: Mapping[str, T], new: Mapping[str, T]) -> Mapping[str, T]:
    """Return the union of two registries.

    what : type of the objects, for the message

    Raises
    ------
    InputError
        If both registries contain the same name, which would make results ambiguous.

    """
    if both := sorted(known.keys() & new.keys()):
        remedy = (
            "rename the new one, or label its plug-in by --plugin LABEL=FILE.py"
            if what == "solver"
            else "rename the new one, or load one of the two"
        )
        raise InputError(f"{what} {both[0]!r} of the plug-in already exists; {remedy}")
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
    annotated = option_types(solver)
    changes: dict[str, Any] = {}
    settings: dict[str, Any] = {}
    for name, value in spec.options.items():
        known = known_options(solver, name)
        for other in reserved or ():
            known.pop(other, None)
        if name in known:
            where, kind = f"{spec.name}: {name}", annotated.get(name)
            value = _option(where, value, known[name], kind)
        elif name in (reserved or ()) or not accepts_any(solver):
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
        raise InputError(f"{spec.name}: {_one_line(e)}") from None
    return configured


def _option(where: str, value: Any, current: Any, annotation: Any) -> Any:
    """Check the type of an option, and return its value; an int may become a float.

    current : default of the option, whose type is required if there is no annotation
    """
    kinds = classes_of(annotation)
    if kinds is None:
        kinds = None if current is None else (type(current),)
    if kinds is None or (value is None and current is None):
        return value
    if isinstance(value, bool):
        if bool in kinds:
            return value
    elif isinstance(value, kinds):
        return value
    elif float in kinds and isinstance(value, int):
        return float(value)
    elif any(issubclass(kind, Mapping) for kind in kinds) and isinstance(
        value, Mapping
    ):
        return value
    expected = " or ".join(
        "None" if kind is NoneType else kind.__name__ for kind in kinds
    )
    got = type(value).__name__
    raise InputError(f"{where} = {value!r} is of type {got}; expected {expected}")


def _no_file(plugin_file: PluginFile) -> InputError:
    return InputError(
        f"{plugin_file.path}: no such file; expected a Python file, or LABEL=FILE.py"
    )


def _imported(path: Path) -> ModuleType:
    """Import a plug-in file as a separate package; see the module docstring."""
    whole = path.resolve()
    stem = re.sub(r"\W", "_", whole.stem)
    name = f"plugin_{stem}_{hex_digest([bytes(whole)])}"
    spec = importlib.util.spec_from_file_location(
        name,
        whole,
        loader=_PluginLoader(name, str(whole)) if path.suffix == ".py" else None,
        submodule_search_locations=[_BESIDE + str(whole.parent)],
    )
    if spec is None or spec.loader is None:
        raise InputError(f"{path}: not a Python file; its name must end in .py")
    _forget(name)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look up their module in sys.modules
    try:
        with redirect_stdout(sys.stderr):
            spec.loader.exec_module(module)
    except (Exception, SystemExit) as e:  # raised by code of the plug-in
        _forget(name)
        raise _import_error(str(path), e) from None
    return module


def _forget(package: str) -> None:
    """Remove a package and its submodules from `sys.modules`, for a new import."""
    for name in [n for n in sys.modules if f"{n}.".startswith(f"{package}.")]:
        del sys.modules[name]
    importlib.invalidate_caches()


class _PluginLoader(SourceFileLoader):
    """Loader of the modules of a plug-in, which redirects imports to neighbours."""

    def get_code(self, fullname: str) -> CodeType:
        # bypass __pycache__, since the rewritten imports depend on the files in the
        # folder
        package = fullname.partition(".")[0]
        (entry,) = sys.modules[package].__path__
        imports = _Imports(package, entry.removeprefix(_BESIDE))
        tree = imports.visit(ast.parse(self.get_data(self.path), self.path))
        code: CodeType = compile(tree, self.path, "exec", dont_inherit=True)
        return code


class _Imports(ast.NodeTransformer):
    """Transformer that replaces module names in imports of a plug-in by full names."""

    def __init__(self, package: str, folder: str) -> None:
        self._package = package
        self._folder = folder

    def visit_ImportFrom(self, node: ast.ImportFrom) -> ast.AST:
        if node.level == 0 and node.module is not None:
            node.module = self._full(node.module)
        return node

    def visit_Import(self, node: ast.Import) -> list[ast.AST]:
        statements = []
        for alias in node.names:
            full, bound = self._full(alias.name), alias.asname
            names = [alias]
            if full != alias.name:
                first = alias.name.partition(".")[0]
                names = [ast.alias(full, bound or first)]
                if (
                    bound is None and first != alias.name
                ):  # `import a.b` binds the name a
                    names += [ast.alias(self._full(first), first)]
            statements += [ast.Import([name]) for name in names]
        return [
            ast.fix_missing_locations(ast.copy_location(statement, node))
            for statement in statements
        ]

    def _full(self, name: str) -> str:
        first = name.partition(".")[0]
        if _neighbour(first, self._folder) is not None:
            return f"{self._package}.{name}"
        return f"mortarbench.{name}" if first in _ROOMS else name


class _NeighbourFinder(FileFinder):
    """Finder that offers the neighbours of a plug-in as submodules of its package."""

    def __init__(self, folder: str) -> None:
        super().__init__(
            folder,
            (ExtensionFileLoader, EXTENSION_SUFFIXES),
            (_PluginLoader, SOURCE_SUFFIXES),
        )

    def find_spec(
        self, fullname: str, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        spec = super().find_spec(fullname, target)
        if spec is not None and spec.submodule_search_locations is not None:
            folders = spec.submodule_search_locations
            spec.submodule_search_locations = [_BESIDE + folder for folder in folders]
        return spec


def _neighbour_finder(entry: str) -> _NeighbourFinder:
    """Return the finder for an entry of the ``__path__`` of a plug-in's package."""
    if not entry.startswith(_BESIDE):
        raise ImportError  # not an entry of a plug-in
    return _NeighbourFinder(entry.removeprefix(_BESIDE))


sys.path_hooks.append(_neighbour_finder)


def stand_for_harness() -> None:
    """Install a module `harness` with the exported names, for plug-ins that import it.

    Only worker processes call this function directly. In the process of a user, a
    module of this name may belong to the user; see `_standing_for_harness`.
    """
    exports = ModuleType("harness")  # a module without a path has no submodules
    exports.__dict__["__getattr__"] = partial(getattr, import_module(__package__))
    exports.__dict__["__all__"] = import_module(__package__).__all__
    sys.modules["harness"] = exports


@contextmanager
def _standing_for_harness() -> Iterator[None]:
    """Install the module `harness` within the block, and restore a previous module."""
    before = sys.modules.get("harness")
    stand_for_harness()
    try:
        yield
    finally:
        del sys.modules["harness"]
        if before is not None:
            sys.modules["harness"] = before


def _neighbour(name: str, folder: str) -> ModuleSpec | None:
    """Return the spec of a module or package in a folder, or None if it is missing.

    Packages without ``__init__`` are not found.
    """
    if name in _NEVER_BESIDE:
        return None
    spec = PathFinder.find_spec(name, [folder])
    return None if spec is None or spec.origin is None else spec


def _neighbours(path: Path) -> set[Path]:
    """Return the files that a plug-in imports from its folder, even indirectly."""
    found: set[Path] = set()
    unread = [path]
    while unread:
        file = unread.pop()
        for name in _imported_names(file):
            spec = _neighbour(name, str(path.parent))
            if spec is None or spec.origin is None:
                continue
            files = {Path(spec.origin)}
            for folder in spec.submodule_search_locations or ():
                for ending in (*SOURCE_SUFFIXES, *EXTENSION_SUFFIXES):
                    files |= {*Path(folder).rglob(f"*{ending}")}
            new = files - found - {path}
            found |= new
            unread += [f for f in new if f.suffix in SOURCE_SUFFIXES]
    return found


def _imported_names(file: Path) -> set[str]:
    """Return the top-level names in the import statements of a file.

    The names in relative imports are included, since ``from .helper import f`` imports
    a neighbour of the plug-in. If the file has a syntax error, the result is empty, and
    the import of the file reports the error.
    """
    names: set[str] = set()
    try:
        tree = ast.parse(file.read_bytes())
    except (SyntaxError, ValueError, RecursionError):
        return names
    for node in ast.walk(tree):
        match node:
            case ast.Import(names=aliases) | ast.ImportFrom(module=None, names=aliases):
                names |= {alias.name.partition(".")[0] for alias in aliases}
            case ast.ImportFrom(module=str(module)):
                names.add(module.partition(".")[0])
    return names


def _checked(where: str, solvers: Any, problems: Any) -> Plugin:
    """Check the types of the objects of a plug-in; return a `Plugin`.

    where : file or "entry points", for messages
    """
    for name, offered in ("SOLVERS", solvers), ("PROBLEMS", problems):
        if not isinstance(offered, Mapping):
            raise InputError(
                f"{where}: {name} is of type {_type(offered)}; expected dict"
            )
        for key, thing in offered.items():
            with located(f"{where}: {name}[{key!r}]"):
                if isinstance(thing, type):
                    raise InputError("a class; expected an instance")
                if not isinstance(key, str):
                    raise InputError("the key is not a string; expected a name")
                if name == "PROBLEMS":
                    _check_family(thing)
                elif not is_solver(thing):
                    raise InputError(
                        f"of type {_type(thing)}; expected a solver with the "
                        f"methods {' and '.join(_SOLVER_PARTS)}"
                    )
    return Plugin(solvers=dict(solvers), problems=dict(problems), origin=where)


def _check_family(family: Any) -> None:
    """Raise InputError unless an object is a family with keys, defaults and forms."""
    if not isinstance(family, Family) or not is_dataclass(family):
        raise InputError(
            f"of type {_type(family)}; expected a frozen dataclass that inherits "
            "from mortarbench.Family"
        )
    forms = getattr(family, "forms", None)
    if not isinstance(forms, tuple) or not forms or {type(f) for f in forms} != {str}:
        raise InputError(f"forms = {shown(forms)}; expected a tuple of strings")
    keys = keys_of(type(family))
    for name, value in family.params.items():
        if keys[name].default not in (None, value):
            raise InputError(
                f"{name} = {value!r}; expected the default of the class, "
                f"{keys[name].default!r}, since case names omit it"
            )


def is_solver(thing: object) -> bool:
    """Return True if `thing`, an object or a class, has the methods of a solver."""
    return all(hasattr(thing, part) for part in _SOLVER_PARTS)


def check_solver(thing: object) -> None:
    """Check that `thing` is a solver or a string, which may name a solver.

    Raises
    ------
    InputError
        If `thing` is the class of a solver, or neither a solver nor a string.

    """
    methods = " and ".join(_SOLVER_PARTS)
    if isinstance(thing, type) and is_solver(thing):
        raise InputError(
            f"solver = {thing.__name__} is a class; expected an instance, such as "
            f"{thing.__name__}()"
        )
    if not isinstance(thing, str) and not is_solver(thing):
        raise InputError(
            f"solver = {shown(thing)}; expected the name of a solver, or an object "
            f"with the methods {methods}"
        )


def _import_error(where: str, e: BaseException) -> InputError:
    return InputError(f"{where}: failed to import: {_type(e)}: {_one_line(e)}")


def _type(thing: object) -> str:
    return type(thing).__name__


def _one_line(e: BaseException) -> str:
    return " ".join(str(e).split())
