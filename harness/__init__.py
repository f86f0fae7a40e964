"""Interfaces between problems, solvers and reports; measurement and verification.

Each exported name is imported on first access. Commands that only list cases and
solvers therefore do not load NumPy and SciPy. `__init__.pyi` lists the exported names.
"""

from lazy_loader import attach_stub

__getattr__, __dir__, __all__ = attach_stub(__name__, __file__)
