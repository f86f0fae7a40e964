"""Families and solvers of the toy problem."""

import sys

from mortarbench.harness.registry import load_plugin
from mortarbench.registries import Registries
from tests.support import TOY_PROBLEM


def toy_registries(reference=None, **more):
    """Return registries that contain the toy problem alone."""
    plugin = load_plugin(TOY_PROBLEM)
    return Registries(
        families=plugin.problems, solvers=plugin.solvers, reference=reference,
        start=(sys.executable, "-P", str(TOY_PROBLEM)), **more,
    )  # fmt: skip
