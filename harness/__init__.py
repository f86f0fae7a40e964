"""The contract between problems, solvers and reports; measuring and judging.

Names are imported at their first access, so that commands that only read names of cases
and solvers do not load NumPy and SciPy. They are listed in `__init__.pyi`.
"""

from lazy_loader import attach_stub

# the full name, also if Python runs the folder as `python -m harness`
__getattr__, __dir__, __all__ = attach_stub("mortarbench.harness", __file__)
