"""Examples in docstrings of functions that users and plug-ins call."""

import doctest
from importlib import import_module
from textwrap import dedent

import numpy as np
import pytest

from mortarbench.problems import elastic
from mortarbench.solvers.smalbe.solver import SMALBE

MODULES = ["contact.friction", "fem.elasticity", "fem.mesh"]


@pytest.mark.parametrize("name", MODULES)
def test_examples_print_what_their_docstrings_show(name):
    result = doctest.testmod(import_module(f"mortarbench.problems.{name}"))

    assert result.attempted
    assert not result.failed


def test_the_elastic_family_of_the_docstring_transfers_its_pressure():
    _, _, example = elastic.__doc__.partition("::\n")
    names = {name: getattr(elastic, name) for name in elastic.__all__} | {"np": np}
    exec(dedent(example), names)
    case = names["case"]
    s = SMALBE().prepare(case.qp, 1e-8)()

    assert case.quantities(s)["contact_force"] == pytest.approx([0, -1e6], abs=1)
