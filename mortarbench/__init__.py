"""Compare QP solvers on elastic contact problems: what users may rely on.

>>> import mortarbench as mb
>>> case = mb.build("beam-ring/Nr=4/Nh=3/steps=1/dual")
>>> answer = mb.solve(case, "smalbe")
>>> str(answer.verdict)
'verified'

Nothing prints unless asked. Bad input raises `InputError`, whose text is one line. The
command line is a thin caller of these functions.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from harness.errors import InputError
    from mortarbench.answer import Answer, solve
    from mortarbench.case import Case, build
    from mortarbench.listing import Listing, problems, solvers, suites
    from mortarbench.progress import Event
    from mortarbench.reporting import Report, report
    from mortarbench.results import Results, load, merge, run
    from mortarbench.validation import Validation, validate

_MODULES = {
    "Answer": "mortarbench.answer",
    "Case": "mortarbench.case",
    "Event": "mortarbench.progress",
    "InputError": "harness.errors",
    "Listing": "mortarbench.listing",
    "Report": "mortarbench.reporting",
    "Results": "mortarbench.results",
    "Validation": "mortarbench.validation",
    "build": "mortarbench.case",
    "load": "mortarbench.results",
    "merge": "mortarbench.results",
    "problems": "mortarbench.listing",
    "report": "mortarbench.reporting",
    "run": "mortarbench.results",
    "solve": "mortarbench.answer",
    "solvers": "mortarbench.listing",
    "suites": "mortarbench.listing",
    "validate": "mortarbench.validation",
}

__all__ = [
    "Answer",
    "Case",
    "Event",
    "InputError",
    "Listing",
    "Report",
    "Results",
    "Validation",
    "build",
    "load",
    "merge",
    "problems",
    "report",
    "run",
    "solve",
    "solvers",
    "suites",
    "validate",
]


def __getattr__(name: str) -> Any:
    """Import what is asked for: a help text needs neither numpy nor scipy."""
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_MODULES[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
