"""Undivided bodies need nothing of the room for subdomains."""

import subprocess
import sys

BUILD = """
import sys
from mortarbench.harness.names import parse
from mortarbench.problems import PROBLEMS
from mortarbench.solvers.reference.solve import reference_solution
case = parse("beam-ring/Nr=4/Nh=3/steps=1/dual", PROBLEMS)
case.build(reference_solution)
print([name for name in sys.modules if name.startswith("mortarbench.problems.feti")])
"""


def test_undivided_bodies_do_not_import_subdomains():
    done = subprocess.run(
        [sys.executable, "-c", BUILD], capture_output=True, text=True, check=True
    )

    assert done.stdout.strip() == "[]"
