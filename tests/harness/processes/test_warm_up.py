"""Times of dualisation exclude effects of first calls, since the first dual case is
built twice.
"""

import time
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
import pytest
from scipy.sparse import csc_array

from mortarbench.harness import QP, Case, Family, no_rows
from mortarbench.harness.processes import cases
from mortarbench.harness.processes.cases import Cases


@dataclass(frozen=True)
class Slow(Family):
    """Family that reports ten times the time for its first dual case."""

    forms: ClassVar = ("primal", "dual")
    n: int = 1
    built: list = field(default_factory=list, compare=False)

    def build(self, form, reference):
        self.built.append(form)
        seconds = None
        if form == "dual":
            seconds = 0.01 if self.built.count("dual") == 1 else 0.001
        if self.n > 1:
            time.sleep(0.05)
        A, b = no_rows(2), np.zeros(0)
        qp = QP(P=csc_array(np.eye(2)), q=np.ones(2), A=A, b=b, G=A, h=b,
                lb=np.zeros(2), ub=np.ones(2))  # fmt: skip
        return Case(
            qp=qp, recover=lambda s: s.x, quantities=lambda _: {},
            dualise_seconds=seconds,
        )  # fmt: skip


@pytest.fixture
def build(tmp_path):
    family = Slow()
    worker = Cases({"slow": family}, lambda _: None)

    def ask(form, n=1):
        request = {
            "build": {"family": "slow", "params": {"n": n}, "form": form,
                      "name": f"slow/n={n}/{form}"},
            "qp": str(tmp_path / f"{n}-{form}.npz"), "keep": 1,
        }  # fmt: skip
        return worker.answer(request)["meta"]["dualise_seconds"]

    ask.family = family
    return ask


def test_the_first_dual_case_of_a_process_is_built_twice_and_the_second_counts(build):
    assert build("primal") is None
    assert build("dual") == 0.001
    assert build("dual", n=2) == 0.001
    assert build.family.built == ["primal", "dual", "dual", "dual"]


def test_a_case_that_takes_long_is_not_built_twice(build, monkeypatch):
    monkeypatch.setattr(cases, "MAX_WARM_UP_SECONDS", 0.02)
    assert build("dual", n=2) == 0.01
    assert build.family.built == ["dual"]
