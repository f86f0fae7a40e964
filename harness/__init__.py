"""Interfaces between problems, solvers and reports; measurement and verification.

Names are imported at their first access, so that commands that only list cases and
solvers do not load NumPy and SciPy. `__init__.pyi` lists the names.
"""

from lazy_loader import attach_stub

# the full package name, also for `python -m harness` in a checkout
__getattr__, __dir__, __all__ = attach_stub("mortarbench.harness", __file__)
