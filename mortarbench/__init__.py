"""Benchmark of QP solvers on elastic contact problems: the public interface.

>>> import mortarbench as mb
>>> case = mb.build("beam-ring/Nr=4/Nh=3/steps=1/dual")
>>> answer = mb.solve(case, "smalbe")
>>> str(answer.verdict)
'verified'

Plug-ins import `QP`, `Solution`, `Status`, `Case` and `Family` from here.

Functions print no output unless requested, except that `run` shows its progress in a
notebook. If their input is invalid, they raise an
`InputError` with a one-line message. The command line calls the same functions.
"""

from importlib import import_module
from types import ModuleType
from typing import Any

from lazy_loader import attach_stub

from mortarbench import problems, solvers

# Names are imported at first use, because help texts need neither numpy nor scipy.
_export, __dir__, __all__ = attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    if name == "__version__":
        return import_module("importlib.metadata").version(__name__)
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return _export(name)


class _Listed(ModuleType):
    """Package that can be called to list its contents: `solvers()`, `problems()`."""

    def __call__(self, **options: Any) -> Any:
        """Return the `Listing` of the same name in `mortarbench.listing`."""
        function = self.__name__.rpartition(".")[2]
        return getattr(import_module("mortarbench.listing"), function)(**options)


for package in (problems, solvers):
    package.__class__ = _Listed
