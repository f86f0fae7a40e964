"""Options of solvers from the command line: types, sweeps and labels."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import pytest

from mortarbench.harness.registry import SolverSpec, options_of, resolve
from mortarbench.harness.suite.solver_options import (
    listed_options,
    parse_options,
    sweep,
)
from tests.support.refusals import refused


@dataclass(frozen=True)
class Method:
    max_iter: int = 200
    alpha: float = 1.5
    scaling: bool = True
    mode: Literal["fast", "exact"] = "fast"
    title: str = "none"
    seed: int | None = None
    shape: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if self.max_iter < 1:
            raise ValueError("max_iter must be positive")

    def declines(self, qp):
        return None

    def prepare(self, qp, tol):
        raise AssertionError("it is only named, never run")


@dataclass(frozen=True)
class Plain:
    steps: int = 7

    declines, prepare = Method.declines, Method.prepare


def typed_options(name, text, registry):
    """Return the value of an option that is set by one text KEY=VALUE."""
    options = {key: value for key, (value,) in parse_options([text]).items()}
    solver = resolve(SolverSpec(name=name, label=name, options=options), registry)
    return {key: options_of(solver)[key] for key in options}


SOLVERS = {"method": Method(), "plain": Plain()}
SPECS = tuple(SolverSpec(name=name, label=name) for name in SOLVERS)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("max_iter=50", 50),
        ("alpha=2", 2.0),
        ("alpha=1e-3", 0.001),
        ("scaling=false", False),
        ("mode=exact", "exact"),
        ("title=7", "7"),
        ("title=a=b", "a=b"),
        ("seed=7", 7),
        ("seed=none", None),
    ],
)
def test_a_value_is_read_as_the_type_of_its_field(text, value):
    ((_, found),) = typed_options("method", text, SOLVERS).items()

    assert found == value
    assert type(found) is type(value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "max_itr=5",
            "method: unknown option 'max_itr'; did you mean 'max_i",
        ),
        ("max_iter=5.5", "method: max_iter = '5.5'; expected an integer"),
        ("max_iter=1_0", "method: max_iter = '1_0'; expected an integer"),
        ("max_iter=0", "method: max_iter must be positive"),
        ("alpha=fast", "method: alpha = 'fast'; expected a number"),
        ("scaling=2", "method: scaling = '2'; expected true or false"),
        ("mode=slow", "method: mode = 'slow'; expected fast or exact"),
        ("seed=x", "method: seed = 'x'; expected an integer or none"),
        (
            "shape=1",
            "method: shape = '1'; expected tuple",
        ),
        ("max_iter", "--option 'max_iter'; expected [SOLVER.]KEY=VALUE, such as "),
        ("max_iter=", "--option 'max_iter='; expected [SOLVER.]KEY=VALUE"),
        ("=5", "--option '=5'; expected [SOLVER.]KEY=VALUE"),
        (".max_iter=5", "--option '.max_iter=5'; expected [SOLVER.]KEY=VALUE"),
        ("max_iter=5,6", "method: max_iter = '5,6'; expected an integer"),
        ("plain.steps=5", "method: unknown option 'plain.steps'; known:"),
    ],
)
def test_unknown_options_and_values_are_refused(text, message):
    with refused(start=message):
        typed_options("method", text, SOLVERS)


def labels(*texts, specs=SPECS):
    return [spec.label for spec in sweep(specs, parse_options(texts), SOLVERS)]


def test_repeated_options_span_a_grid_of_the_solvers_that_have_the_option():
    """A solver without the option is unchanged."""
    assert labels("max_iter=5", "max_iter=6", "scaling=false") == [
        "method max_iter=5 scaling=false", "method max_iter=6 scaling=false", "plain"
    ]  # fmt: skip
    assert labels("steps=1") == ["method", "plain steps=1"]
    assert labels() == ["method", "plain"]


def test_an_option_may_be_set_for_one_label_or_name_only():
    two = [SolverSpec(name="method", label="qpsolvers:a.b"), *SPECS]

    assert labels("qpsolvers:a.b.max_iter=5", specs=two) == [
        "qpsolvers:a.b max_iter=5", "method", "plain"
    ]  # fmt: skip
    assert labels("method.alpha=2", specs=two) == [
        "qpsolvers:a.b alpha=2.0", "method alpha=2.0", "plain"
    ]  # fmt: skip


def test_labels_contain_the_value_in_canonical_form():
    assert labels("alpha=1e-3") == labels("alpha=0.001")


def test_a_null_arm_has_the_options_of_its_twin():
    null = SolverSpec(name="method", label="method (A/A)", role="null")
    found = sweep([*SPECS[:1], null], {"max_iter": ["5"]}, SOLVERS)

    assert [(s.label, s.role) for s in found] == [
        ("method max_iter=5", ""), ("method max_iter=5 (A/A)", "null")
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("texts", "message"),
    [
        (["max_itr=5"], "--option: unknown option 'max_itr'; did you mean 'max_iter'?"),
        (["max_iter=5"] * 2, "--option: label 'method max_iter=5' is used twice"),
        (["alpha=1", "alpha=1.0"], "--option: label 'method alpha=1.0' is used twice"),
        (["plian.steps=5"], "--option: unknown option 'plian.steps'; did you mean 'pl"),
        (["plain.max_iter=5"], "--option: unknown option 'plain.max_iter'; did you"),
        (["max_iter=0"], "--option: method: max_iter must be positive"),
        (["mode=fast", "mode=slow"], "--option: method: mode = 'slow'; expected fast"),
        (
            [f"{key}={n}" for key in ("max_iter", "alpha") for n in range(1, 50)],
            "--option: options span 2401 variants of method; expected 1 to 1000",
        ),
    ],
)  # fmt: skip
def test_an_invalid_sweep_is_refused(texts, message):
    with refused(start=message):
        labels(*texts)


def test_options_of_a_program_are_those_of_the_command_line():
    values = {"max_iter": [5, np.int64(6)], "scaling": False, "mode": "exact"}
    texts = ("max_iter=5", "max_iter=6", "scaling=false", "mode=exact")

    assert sweep(SPECS, listed_options(values), SOLVERS) == sweep(
        SPECS, parse_options(texts), SOLVERS
    )
    (null,) = sweep(SPECS[:1], listed_options({"seed": None}), SOLVERS)
    assert null.options == {"seed": None}
