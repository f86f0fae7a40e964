"""Readable names of the entries of an environment."""

import doctest

from mortarbench.harness.environment import labels


def test_the_examples_of_the_documentation_hold():
    assert doctest.testmod(labels).failed == 0
