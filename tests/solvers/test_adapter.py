"""Settings of libraries are options of their adapters."""

from dataclasses import replace

import numpy as np
import pytest

import mortarbench as mb
from mortarbench.harness import Status
from mortarbench.harness.registry import SolverSpec, options_of, resolve
from mortarbench.harness.suite.solver_options import parse_options, sweep
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.adapters.clarabel_ import Clarabel
from mortarbench.solvers.adapters.daqp_ import DAQP
from mortarbench.solvers.common.adapter import Adapter
from tests.support.refusals import refused

DIRECT = (
    "clarabel", "osqp", "piqp", "proxqp", "highs", "scs", "daqp", "qpalm", "qoco",
    "qtqp",
)  # fmt: skip


def solver(name, **options):
    return resolve(SolverSpec(name=name, label=name, options=options), SOLVERS)


@pytest.fixture
def qp():
    """Return min ½‖x‖² − Σ j·xⱼ over 0 ≤ xⱼ ≤ 1 with the row Σ xⱼ ≤ 3."""
    n = 8
    return mb.QP.from_arrays(
        np.eye(n), -np.arange(n), G=np.ones((1, n)), h=3, lb=0, ub=1
    )


@pytest.mark.parametrize("name", DIRECT)
def test_the_library_knows_every_setting_that_its_adapter_passes(name, qp, monkeypatch):
    passed = {}

    def tuned(self, **own):
        passed.update(own)
        return own

    monkeypatch.setattr(Adapter, "tuned", tuned)
    SOLVERS[name].prepare(qp, 1e-6)()

    listed = SOLVERS[name].library_settings()
    assert passed
    assert listed is None or passed.keys() <= listed.keys()
    assert (listed is None) == (name == "scs")


@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("clarabel", {"max_step_fraction": 0.5}),
        ("osqp", {"check_termination": 1, "rho": 1e-3}),
        ("piqp", {"tau": 0.3}),
        ("proxqp", {"default_mu_in": 1.0, "default_rho": 10.0}),
        ("highs", {"qp_iteration_limit": 1}),
        ("scs", {"max_iters": 1}),
        ("daqp", {"iter_limit": 1}),
        ("qpalm", {"inner_max_iter": 1}),
        ("qoco", {"max_iters": 1}),
        ("qtqp", {"step_size_scale": 0.3}),
        ("cvxpy:CLARABEL", {"max_step_fraction": 0.5}),
        ("qpsolvers:osqp", {"check_termination": 1}),
    ],
)
def test_a_setting_by_its_own_name_changes_the_solve(name, options, qp):
    plain, changed = (solver(name, **o).prepare(qp, 1e-6)() for o in ({}, options))
    assert plain.status is Status.SOLVED
    assert (changed.status, changed.iterations) != (plain.status, plain.iterations)
    assert options.items() <= options_of(solver(name, **options)).items()


def test_the_value_of_the_user_replaces_a_tolerance_of_the_adapter(qp):
    loose = dict.fromkeys(("tol_feas", "tol_gap_abs", "tol_gap_rel"), 0.1)
    tight, free = (solver("clarabel", **o).prepare(qp, 1e-9)() for o in ({}, loose))
    assert free.iterations < tight.iterations
    answer = mb.solve(qp, "clarabel", tol=1e-9, **loose)
    assert answer.record.options["tol_feas"] == 0.1


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("clarabel", {"max_step_fractoin": 1}, "did you mean 'max_step_fraction'?"),
        ("clarabel", {"max_step_fraction": "a"}, "expected a number"),
        ("clarabel", {"equilibrate_max_iter": -1}, "equilibrate_max_iter = -1: "),
        ("piqp", {"kkt_solver": "qr"}, "expected one of dense_cholesky, sparse_ldlt"),
        ("scs", {"nonsense": 1}, "'nonsense' is an invalid keyword"),
        ("qpsolvers:clarabel", {"backend": "osqp"}, "unknown option 'backend'"),
        ("qpsolvers:clarabel", {"nonsense": 1}, "unknown option 'nonsense'"),
        ("pdas", {"settings": 1}, "unknown option 'settings'"),
    ],
)
def test_what_the_library_refuses_is_refused_in_one_line(name, options, message):
    with refused(message, start=f"{name}: "):
        solver(name, **options)


@pytest.mark.parametrize("kind", [Clarabel, DAQP])
def test_an_object_with_an_unknown_setting_is_refused(kind):
    with pytest.raises(ValueError, match="nonsense = 1: "):
        kind(settings={"nonsense": 1})


def test_the_command_line_converts_to_the_type_of_the_default():
    specs = [SolverSpec(name=n, label=n) for n in ("clarabel", "qpsolvers:quadprog")]
    given = ["clarabel.max_step_fraction=1", "max_iter=50", "verbose=true"]
    clarabel, other = sweep(specs, parse_options(given), SOLVERS)

    assert clarabel.options == {
        "max_step_fraction": 1.0, "max_iter": 50, "verbose": True
    }  # fmt: skip
    assert isinstance(clarabel.options["max_step_fraction"], float)
    assert "max_step_fraction=1.0" in clarabel.label
    assert other.options == {}  # quadprog does not list settings, and is not addressed


def test_settings_of_a_library_without_a_list_are_passed_if_addressed():
    specs = [SolverSpec(name=n, label=n) for n in ("qpsolvers:quadprog", "clarabel")]
    given = parse_options(["qpsolvers:quadprog.initvals=none"])
    assert sweep(specs, given, SOLVERS)[0].options == {"initvals": None}


def test_without_the_library_settings_are_checked_by_nobody(monkeypatch):
    def missing(self):
        raise ImportError

    monkeypatch.setattr(Clarabel, "library", missing)
    assert replace(Clarabel(), settings={"any": 1}).library_settings() is None
