"""Manufactured QPs."""

import doctest

from mortarbench.harness.conformance import manufactured


def test_the_example_of_the_documentation_holds():
    assert doctest.testmod(manufactured).failed == 0
