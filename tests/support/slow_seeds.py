"""Seeds as parameters of tests: few in default runs, all in slow runs."""

import pytest


def seeds(few, all_):
    """Return the seeds below `all_`; those from `few` on are slow."""
    slow = pytest.mark.slow
    return [*range(few), *(pytest.param(k, marks=slow) for k in range(few, all_))]
