"""Cross-validation: planted errors are measured and attributed to the right solver."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
from scipy.sparse import csc_array

from mortarbench.cli.main import main
from mortarbench.harness import QP, Case, Mechanics, Solution, Status, no_rows
from mortarbench.harness.crossval.comparison import (
    StoredAnswer,
    compare_answers,
)
from mortarbench.harness.files.qpfile import qp_digest
from mortarbench.harness.files.store import write_point
from mortarbench.harness.names import parse
from mortarbench.harness.record import Verdict
from mortarbench.harness.registry import SolverSpec, load_plugin
from mortarbench.harness.results.journal import Journal, read_journal
from mortarbench.harness.verify.verdicts import judged, new_record
from mortarbench.problems import PROBLEMS
from mortarbench.registries import Registries
from mortarbench.solvers.reference.solve import reference_solution
from tests.support import FALSE_CLAIMS
from tests.support.exact_solutions import refined_point
from tests.support.stored import save_solution

pytestmark = pytest.mark.together

PLUGIN = load_plugin(FALSE_CLAIMS)
FAMILIES = {**PROBLEMS, **PLUGIN.problems}
BEAM = "beam-ring/Nr=2/Nh=1/steps=2"
HONEST = ("a", "b", "c", "d")


def built(text, families=FAMILIES):
    return parse(text, families).build(reference_solution)


def record_of(text, label, tol=1e-8, **more):
    spec = SolverSpec(name=label, label=label)
    return new_record(
        parse(text, FAMILIES), spec, options={}, tol=tol, repeat=0, environment="here",
        **more,
    )  # fmt: skip


def write(folder, answers, tol=1e-8):
    """Write a result folder with entries (solver, case, solution or verdict)."""
    cases = {}
    with Journal(folder, "here") as journal:
        for label, text, answer in answers:
            record = record_of(text, label, tol)
            if isinstance(answer, Verdict):
                journal.append(record.replace(status=answer, message="as it ended"))
                continue
            case = cases.setdefault(text, built(text))
            record = record.replace(qp=qp_digest(case.qp, serialised=True))
            record = judged(record, case.qp, answer)
            if np.isfinite(answer.x).all():
                record = record.replace(vectors=save_solution(folder, answer))
            journal.append(record)
    return folder


@pytest.fixture
def cli(capsys):
    """Validate a folder; return the exit code, stdout and stderr."""

    def cli(*argv):
        registries = Registries(
            families=PROBLEMS, solvers={}, reference=reference_solution
        )
        code = main(registries, ["validate", *map(str, argv)])
        return code, *capsys.readouterr()

    return cli


def verdict_on(cli, folder, *more):
    code, out, _ = cli(folder, "--json", *more)
    return code, json.loads(out)


def listed(verdict, outcome="refuted"):
    return [a for a in verdict["answers"] if a["outcome"] == outcome]


def culprits(verdict):
    return {a["solver"] for a in listed(verdict)}


@pytest.fixture(scope="module")
def truths():
    """Return the exact answer to each form of two load steps, with its case."""
    found = {}
    for step in (1, 2):
        for form in ("primal", "dual", "dual-bounds"):
            case = built(f"{BEAM}/step={step}/{form}")
            found[step, form] = (case, reference_solution(case.qp))
    return found


def disturbed(case, s, size):
    """Displace an answer of any form by `size`·‖u*‖ in the energy norm."""
    rng = np.random.default_rng(141421)
    point, _ = refined_point(case)
    if case.qp.h.size:
        v = rng.standard_normal(s.x.size)
        v[case.mechanics.exact.fixed] = 0
    else:
        v = np.abs(rng.standard_normal(s.x.size)) * (s.x != 0)
        if case.qp.b.size:  # keep the equality rows satisfied
            A = np.asarray(case.qp.A)
            v = v - np.linalg.pinv(A) @ (A @ v)
    return replace(s, x=s.x + size * point.norm / np.sqrt(v @ (case.qp.P @ v)) * v)


@pytest.mark.parametrize("form", ["primal", "dual", "dual-bounds"])
def test_a_planted_error_is_measured_and_only_its_solver_is_named(
    form, truths, tmp_path, cli
):
    case, s = truths[2, form]
    forms = ("primal", "dual", "dual-bounds")
    answers = [
        (label, f"{BEAM}/{f}", truths[2, f][1]) for label in HONEST for f in forms
    ]
    answers.append(("planted", f"{BEAM}/{form}", disturbed(case, s, 1e-4)))

    code, verdict = verdict_on(cli, write(tmp_path, answers))

    assert code == 1
    assert culprits(verdict) == {"planted"}
    (wrong,) = listed(verdict)
    assert wrong["case"] == f"{BEAM}/{form}"
    assert wrong["text"]
    assert wrong["error"] == pytest.approx(1e-4, rel=1e-4)
    assert wrong["bound"] >= wrong["error"]


def test_the_answer_to_the_step_before_is_refuted(truths, tmp_path, cli):
    stale = PLUGIN.solvers["stale"]
    answers = []
    for step in (1, 2):
        text = f"{BEAM}/step={step}/dual-bounds"
        case, s = truths[step, "dual-bounds"]
        answers += [(label, text, s) for label in HONEST]
        answers.append(("stale", text, stale.prepare(case.qp, 1e-8)()))

    code, verdict = verdict_on(cli, write(tmp_path, answers))

    assert code == 1
    (wrong,) = listed(verdict)
    assert (wrong["solver"], wrong["case"]) == ("stale", f"{BEAM}/dual-bounds")
    assert wrong["error"] > 0.1


def test_cases_that_a_budget_excludes_are_listed(truths, tmp_path, cli):
    answers = [
        ("a", f"{BEAM}/step={step}/dual", truths[step, "dual"][1]) for step in (1, 2)
    ]
    code, verdict = verdict_on(cli, write(tmp_path, answers), "--budget", 0)

    assert code == 0
    assert verdict["counts"]["answers"] == 1
    (left,) = listed(verdict, "not validated")
    assert left["text"] == "not begun within the budget of 0 s"


@pytest.mark.parametrize("form", ["primal", "dual-bounds"])
def test_a_tensile_multiplier_is_refuted(form, truths, tmp_path, cli):
    case, s = truths[2, form]
    wrong = PLUGIN.solvers["pulls"].prepare(case.qp, 1e-8)()
    if form == "dual-bounds":
        wrong = replace(s, x=np.where(s.x > 0, s.x, -s.x.max()))
    answers = [(label, f"{BEAM}/{form}", s) for label in HONEST]
    answers.append(("pulls", f"{BEAM}/{form}", wrong))

    code, verdict = verdict_on(cli, write(tmp_path, answers))

    assert (code, culprits(verdict)) == (1, {"pulls"})


class Dense:
    """Inverse of a nonsingular K."""

    def __init__(self, K):
        self.inverse, self.kernel = np.linalg.inv(K), np.zeros((len(K), 0))

    def __call__(self, b):
        return self.inverse @ b

    def congruence(self, B):
        return np.asarray(B @ (B @ self.inverse).T)


def stored_answer(case, label, s, tol=1e-8):
    record = record_of(f"{BEAM}/primal", label, tol).replace(claimed=s.status.value)
    return StoredAnswer(record=record, case=case, solution=s)


@pytest.fixture
def duplicate():
    """Return two springs pressed by a force of 2 against a wall at 1, with a duplicate
    contact row.
    """
    K = np.array([[2.0, -1.0], [-1.0, 1.0]])
    primal = QP(
        P=csc_array(K), q=np.array([0.0, -2.0]), A=no_rows(2), b=np.zeros(0),
        G=csc_array([[0.0, 1.0], [0.0, 1.0]]), h=np.ones(2),
        lb=np.full(2, -np.inf), ub=np.full(2, np.inf),
    )  # fmt: skip
    mechanics = Mechanics(
        primal=primal, to_primal=lambda s: s, factorise=lambda: Dense(K),
        rigid=np.zeros((2, 0)),
    )  # fmt: skip
    return Case(qp=primal, recover=lambda s: s.x, quantities=lambda s: {},
                mechanics=mechanics)  # fmt: skip


def pushed(z, x=(0.5, 1.0)):
    return Solution(
        status=Status.SOLVED, x=np.array(x), y=np.zeros(0), z=np.array(z),
        z_box=np.zeros(2),
    )  # fmt: skip


def finds_nothing(qp):
    raise ArithmeticError("it found nothing")


def test_without_a_reference_answers_are_judged_by_their_residuals(duplicate):
    answers = [
        stored_answer(duplicate, "good", pushed((1.5, 0.0))),
        stored_answer(duplicate, "bad", pushed((1.5, 0.0), (0.45, 0.9))),
    ]

    found = compare_answers(answers, finds_nothing)

    assert [a.outcome for a in found] == ["not validated", "refuted"]
    assert "it found nothing" in found[0].text


def test_claims_without_a_point_are_refuted_and_crashes_are_listed(
    truths, tmp_path, cli
):
    case, s = truths[2, "primal"]
    text = f"{BEAM}/primal"
    answers = [
        ("a", text, s),
        ("denies", text, PLUGIN.solvers["denies"].prepare(case.qp, 1e-8)()),
        ("empty", text, Solution.without_point(case.qp, Status.SOLVED)),
        ("dies", text, Verdict.CRASHED),
        ("picky", text, Verdict.DECLINED),
    ]

    code, verdict = verdict_on(cli, write(tmp_path, answers))

    assert (code, culprits(verdict)) == (1, {"denies", "empty"})
    (dies,) = listed(verdict, "unanswered")
    assert (dies["solver"], dies["text"]) == ("dies", "crashed: as it ended")
    assert not any(a["solver"] == "picky" for a in verdict["answers"])


def test_a_form_that_all_solvers_call_infeasible_is_refuted_by_other_forms(
    truths, tmp_path, cli
):
    _, s = truths[2, "dual"]
    denied = PLUGIN.solvers["denies"].prepare(truths[2, "primal"][0].qp, 1e-8)()
    answers = [("a", f"{BEAM}/dual", s), ("denies", f"{BEAM}/primal", denied)]

    code, verdict = verdict_on(cli, write(tmp_path, answers))

    assert (code, culprits(verdict)) == (1, {"denies"})


def test_a_stored_point_that_was_changed_afterwards_is_not_judged(
    truths, tmp_path, cli
):
    _, s = truths[2, "dual-bounds"]
    answers = [(label, f"{BEAM}/dual-bounds", s) for label in HONEST]
    other = replace(s, x=s.x * (1 + 1e-12))
    write(tmp_path, [*answers, ("planted", f"{BEAM}/dual-bounds", other)])
    stored = {r.solver: r.vectors for r in read_journal(tmp_path)}
    moved = replace(s, x=s.x * (1 + 1e-4))
    write_point(tmp_path / "vectors" / f"{stored['planted']}.npz", moved)

    code, verdict = verdict_on(cli, tmp_path)

    assert code == 0
    (changed,) = listed(verdict, "not validated")
    assert changed["solver"] == "planted"
    assert "its content does not match its digest" in changed["text"]


def test_cases_that_cannot_be_built_as_they_were_are_listed(truths, tmp_path, cli):
    _, s = truths[2, "dual-bounds"]
    answers = [("a", f"{BEAM}/dual-bounds", s), ("a", "half/qp", pulled())]
    write(tmp_path, answers)
    with Journal(tmp_path, "here") as journal:
        for r in read_journal(tmp_path):
            if r.family == "beam-ring":
                other = r.replace(solver="other", run_id="other", qp="0" * 16)
                journal.append(other.replace(case=f"{BEAM}/step=1/dual-bounds",
                                         params={**r.params, "step": 1}))  # fmt: skip

    code, verdict = verdict_on(cli, tmp_path)

    assert code == 0
    why = {a["case"]: a["text"] for a in listed(verdict, "not validated")}
    assert why.keys() == {"half/qp", f"{BEAM}/step=1/dual-bounds"}
    assert "unknown family 'half'" in why["half/qp"]
    assert "digest" in why[f"{BEAM}/step=1/dual-bounds"]


def test_an_answer_to_another_qp_of_the_same_name_is_listed_but_not_judged(
    truths, tmp_path, cli
):
    """Two sessions have the same run_id; a default changed before the second one."""
    _, s = truths[2, "dual-bounds"]
    write(tmp_path, [("a", f"{BEAM}/dual-bounds", s)])
    write_point(tmp_path / "vectors/wrong.npz", replace(s, x=2 * s.x))
    with Journal(tmp_path, "here") as journal:
        (r,) = read_journal(tmp_path)
        journal.append(r.replace(session="later", qp="0" * 16, vectors="wrong"))

    code, verdict = verdict_on(cli, tmp_path)

    assert (code, verdict["counts"]["answers"]) == (0, 1)
    (other,) = listed(verdict, "not validated")
    assert other["run_id"] == f"later-{r.run_id}"
    assert "0" * 16 in other["text"]


def pulled():
    return reference_solution(built("half/qp").qp)


def test_bad_input_is_one_line_and_exit_code_2(tmp_path, cli):
    (tmp_path / "empty").mkdir()
    bare = write(tmp_path / "bare", [("dies", f"{BEAM}/primal", Verdict.CRASHED)])
    foreign = write(tmp_path / "foreign", [("a", "half/qp", pulled())])
    gone = write(tmp_path / "gone", [("a", "half/qp", pulled())])
    shutil.rmtree(gone / "vectors")
    (foreign / "suite.toml").touch()

    for folder, text in (
        (tmp_path / "nowhere", "no such folder"),
        (tmp_path / "empty", "no journal"),
        (bare, "no stored answer can be judged: crashed: as it ended"),
        (foreign / "suite.toml", "suite.toml: a file; expected a result folder"),
        (gone, "no stored answer can be judged: unknown family 'half'"),
        (foreign, "no stored answer can be judged: unknown family 'half'"),
    ):
        code, out, err = cli(folder)
        assert (code, out) == (2, "")
        assert text in err.splitlines()[-1]
        assert "Traceback" not in err


def test_hostile_names_and_huge_numbers_do_not_break_page_or_terminal(
    truths, tmp_path, cli
):
    _, s = truths[2, "primal"]
    name = "<b>evil</b>\x1b[31m\n|x"
    huge = replace(s, x=np.full_like(s.x, 1e300))
    answers = [("a", f"{BEAM}/primal", s), (name, f"{BEAM}/primal", huge)]

    code, out, _ = cli(write(tmp_path, answers))

    def refuse(constant):
        raise AssertionError(constant)

    assert code == 1
    assert "\x1b" not in out
    json.loads((tmp_path / "validation.json").read_text(), parse_constant=refuse)
    page = (tmp_path / "report" / "validation.html").read_text()
    assert "<b>evil" not in page
    assert "&lt;b&gt;evil" in page


def test_a_failing_recovery_affects_only_that_answer(duplicate):
    def back(s):
        if s.z[0] == 0:
            raise ZeroDivisionError("no way back")
        return s

    case = replace(duplicate, mechanics=replace(duplicate.mechanics, to_primal=back))
    answers = [stored_answer(case, k, pushed(z)) for k, z in
               {"a": (1.5, 0.0), "lost": (0.0, 1.5)}.items()]  # fmt: skip

    found = compare_answers(answers, reference_solution)

    assert [a.outcome for a in found] == ["agrees", "not validated"]
    assert "no way back" in found[1].text
