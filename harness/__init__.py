"""The contract between problems, solvers and reports, and the clock.

A name is imported when it is asked for: what only reads names of cases and solvers
needs neither numpy nor scipy, and a refusal should not wait for them. The names are
listed in `__init__.pyi`.
"""

from lazy_loader import attach_stub

# under its full name even where Python runs the folder as `python -m harness`
__getattr__, __dir__, __all__ = attach_stub("mortarbench.harness", __file__)
