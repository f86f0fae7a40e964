"""The example in the documentation of `problems.elastic`."""

from textwrap import dedent

import numpy as np
import pytest

from mortarbench.problems import elastic
from mortarbench.solvers.smalbe.solver import SMALBE


def test_the_elastic_family_of_the_docstring_transfers_its_pressure():
    _, _, example = elastic.__doc__.partition("::\n")
    names = {name: getattr(elastic, name) for name in elastic.__all__} | {"np": np}
    exec(dedent(example), names)
    case = names["case"]
    s = SMALBE().prepare(case.qp, 1e-8)()

    assert case.quantities(s)["contact_force"] == pytest.approx([0, -1e6], abs=1)
