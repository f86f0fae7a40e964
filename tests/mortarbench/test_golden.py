"""Golden digits: objective, energy and contact forces of small cases of every kind.

The digits in `golden.json` were computed to 1e-10 by `python -m
tests.mortarbench.test_golden`, at the commit that introduced this file. They hold the
results still while the code that computes them is replaced: whoever changes a digit
says why. Each energy belongs to one discrete problem, whatever the form of the QP.
"""

import json

import numpy as np
import pytest

import mortarbench as mb
from mortarbench.harness import Record
from tests.support import ROOT

DATA = ROOT / "tests" / "data"
GOLDEN = DATA / "golden.json"
#: quantities that do not depend on rounding; all others are counts or follow from them
QUANTITIES = (
    "energy",
    "contact_force",
    "multiplier_sum",
    "obstacle_force",
    "contact_radius",
    "tangential_force",
    "tip",
    "corner",
    "norm_PFP",
)
TOL = 1e-8  #: requested accuracy; digits must agree to 10·TOL


def digits(entry, tol):
    """Return objective and quantities of the answer to the case of an entry."""
    case = entry["case"].replace("PATH", str(DATA))
    answer = mb.solve(case, entry["solver"], tol, ranks=entry["ranks"])
    assert answer.verdict == "verified", case
    line = answer.record.to_json()
    assert Record.from_json(line).to_json() == line  # a journal can be read back
    values = {k: v for k, v in answer.quantities.items() if k in QUANTITIES}
    return {"objective": answer.record.objective, **values}


@pytest.mark.parametrize("entry", json.loads(GOLDEN.read_text()), ids=lambda e: e["id"])
def test_digits_are_the_golden_ones(entry):
    found = digits(entry, TOL)
    golden = entry["digits"]
    assert found.keys() == golden.keys()
    for name, value in golden.items():
        allowed = 10 * TOL * np.max(np.abs(value))
        np.testing.assert_allclose(
            found[name], value, rtol=0, atol=allowed, err_msg=name
        )


if __name__ == "__main__":
    entries = json.loads(GOLDEN.read_text())
    for entry in entries:
        entry["digits"] = digits(entry, 1e-10)
    GOLDEN.write_text(json.dumps(entries, indent=1) + "\n")
