"""Examples in the documentation of suites and options."""

import doctest

import pytest

from mortarbench.harness.suite import solver_options, suite


@pytest.mark.parametrize("module", [solver_options, suite])
def test_the_examples_of_the_documentation_hold(module):
    assert doctest.testmod(module).failed == 0
