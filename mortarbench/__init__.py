"""Compare QP solvers on elastic contact problems: what users may rely on.

>>> import mortarbench as mb
>>> case = mb.build("beam-ring/Nr=4/Nh=3/steps=1/dual")
>>> answer = mb.solve(case, "smalbe")
>>> str(answer.verdict)
'verified'

Plug-ins import from here, too: `QP`, `Solution`, `Status`, `Case` and `Family`.

Nothing prints unless asked. Bad input raises `InputError`, whose text is one line. The
command line is a thin caller of these functions.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from harness.errors import InputError
    from harness.plugin import Case, Family
    from harness.qp import QP
    from harness.record import Verdict
    from harness.solution import Solution, Status
    from mortarbench.answer import Answer, Multipliers, Verification, solve, verify
    from mortarbench.case import build, export
    from mortarbench.listing import Listing, problems, solvers, suites
    from mortarbench.progress import Event
    from mortarbench.replaying import Replay, replay
    from mortarbench.reporting import Report, report
    from mortarbench.results import Results, load, merge, run
    from mortarbench.validation import Conformance, Validation, test_solver, validate

_MODULES = {
    "Answer": "mortarbench.answer",
    "Case": "harness.plugin",
    "Conformance": "mortarbench.validation",
    "Event": "mortarbench.progress",
    "Family": "harness.plugin",
    "InputError": "harness.errors",
    "Listing": "mortarbench.listing",
    "Multipliers": "mortarbench.answer",
    "QP": "harness.qp",
    "Replay": "mortarbench.replaying",
    "Report": "mortarbench.reporting",
    "Results": "mortarbench.results",
    "Solution": "harness.solution",
    "Status": "harness.solution",
    "Validation": "mortarbench.validation",
    "Verdict": "harness.record",
    "Verification": "mortarbench.answer",
    "build": "mortarbench.case",
    "export": "mortarbench.case",
    "load": "mortarbench.results",
    "merge": "mortarbench.results",
    "problems": "mortarbench.listing",
    "replay": "mortarbench.replaying",
    "report": "mortarbench.reporting",
    "run": "mortarbench.results",
    "solve": "mortarbench.answer",
    "solvers": "mortarbench.listing",
    "suites": "mortarbench.listing",
    "test_solver": "mortarbench.validation",
    "validate": "mortarbench.validation",
    "verify": "mortarbench.answer",
}

__all__ = [
    "QP",
    "Answer",
    "Case",
    "Conformance",
    "Event",
    "Family",
    "InputError",
    "Listing",
    "Multipliers",
    "Replay",
    "Report",
    "Results",
    "Solution",
    "Status",
    "Validation",
    "Verdict",
    "Verification",
    "build",
    "export",
    "load",
    "merge",
    "problems",
    "replay",
    "report",
    "run",
    "solve",
    "solvers",
    "suites",
    "test_solver",
    "validate",
    "verify",
]


def __getattr__(name: str) -> Any:
    """Import a name at its first use: a help text needs neither numpy nor scipy."""
    if name == "__version__":
        return import_module("importlib.metadata").version(__name__)
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = globals()[name] = getattr(import_module(_MODULES[name]), name)
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
