"""Solves on several MPI ranks, compared with one process; failures of ranks."""

import os
import signal
import subprocess
import sys
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import mortarbench as mb
from mortarbench.cli.main import main
from mortarbench.harness.distributed import mpi
from mortarbench.harness.distributed.vectors import DISTRIBUTED_DIGEST
from mortarbench.harness.errors import InputError
from mortarbench.harness.files.store import load_solution
from mortarbench.harness.record import Record
from mortarbench.harness.solution import Status
from mortarbench.registries import Registries
from tests.support import ROOT
from tests.support.hexahedra import TETRAHEDRA
from tests.support.press import described
from tests.support.solid_blocks import TOML, solid_blocks
from tests.support.waiting import soon

pytestmark = pytest.mark.together

CASE = "membranes/S=2/n=4/dual"
SOLVE = ["solve", CASE, "--solver", "smalbe"]
TOL = 1e-8
LANCZOS = 8  #: largest number of products with F before the solve


@pytest.fixture(scope="module")
def answers():
    """Solve on two ranks and on one rank."""
    case = mb.build(CASE)
    return [mb.solve(case, "smalbe", tol=TOL, ranks=n) for n in (2, 1)]


def test_a_solve_on_ranks_is_verified_and_certified(answers):
    first, alone = answers
    assert first.verdict == "verified"
    assert first.energy_bound <= 1e-6
    assert first.record.ranks == 2
    assert first.record.solver == "smalbe ranks=2"
    assert first.record.reported["ranks"] == 2
    assert first.record.objective == pytest.approx(alone.record.objective, rel=1e-12)
    assert first.record.run_id != alone.record.run_id


@pytest.mark.slow
def test_faces_of_a_body_with_tiny_stiffness_have_a_factor_on_ranks():
    """On free components, some rows are smaller than the rounding errors of
    their sum.
    """
    case = "contact-patch/ratio=1e-10/feti=2/dual"
    answer = mb.solve(case, "smalbe", tol=TOL, ranks=2)
    assert answer.record.claimed in ("solved", "iteration_limit")
    # No rank has the assembled K, so the bound holds for every rounding of K.
    assert answer.energy_bound <= 1e-3


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "cube-wall/n=24/feti=8/dual",  # 46 875 components
        "contact-patch/lower=8/upper=6/feti=4/dim=3/distort=0.2/dual",
        "beam-ring/Nr=2/Nh=1/steps=1/feti=2/depth=4/dual",
        "bodies/parts=12/dual",
    ],
)
def test_bodies_in_3d_take_the_same_steps_on_all_numbers_of_ranks(name, tmp_path):
    if name.startswith("bodies"):
        description = solid_blocks(tmp_path, TETRAHEDRA)
        name = name.replace("bodies", f"bodies:{description}")
    case = mb.build(name)
    alone, *several = (mb.solve(case, "smalbe", tol=1e-7, ranks=n) for n in (1, 2, 4))
    for answer in several:
        assert answer.verdict == "verified"
        assert answer.energy_bound <= 1e-6
        assert answer.record.counts == alone.record.counts
        objective = alone.record.objective
        assert answer.record.objective == pytest.approx(objective, rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "contact-patch/lower=4/upper=3/friction=coulomb/mu=0.3/feti=2/dim=3/dual",
        "greco/n=4/dim=3/depth=2/feti=2/dual",
        "hertz-sphere/n=1/against=sphere/Q=0.3/feti=2/dual",
    ],
)
def test_friction_in_3d_has_the_same_displacement_on_all_numbers_of_ranks(name):
    """At this tolerance, gradients are near their rounding errors; steps may differ."""
    whole = mb.solve(name.replace("/feti=2", ""), "smalbe", tol=TOL).record.quantities
    for ranks in (1, 2, 4):
        answer = mb.solve(name, "smalbe", tol=TOL, ranks=ranks)
        assert answer.verdict == "verified"
        assert answer.energy_bound <= 10 * TOL
        divided = answer.record.quantities
        for quantity in ("energy", "max_von_mises", "multiplier_sum"):
            assert divided[quantity] == pytest.approx(whole[quantity], rel=10 * TOL)
        for state in ("open", "stick", "slip"):
            assert divided[state] == whole[state]


@pytest.mark.slow
@pytest.mark.parametrize(
    "name",
    [
        "contact-patch/friction=coulomb/mu=0.2/feti=2/dim=3/distort=0.2/dual",
        "greco/n=4/dim=3/depth=2/feti=2/dual",
        "hertz-sphere/n=1/against=sphere/Q=0.3/feti=2/dual",
    ],
)
def test_friction_in_3d_takes_the_same_steps_on_all_numbers_of_ranks(name):
    """Steps coincide as long as gradients exceed their rounding errors."""
    alone, *several = (mb.solve(name, "smalbe", tol=1e-6, ranks=n) for n in (1, 2, 4))
    for answer in several:
        assert answer.verdict == "verified"
        assert answer.record.counts == alone.record.counts


@pytest.mark.slow
@pytest.mark.parametrize("distort", [0, 0.17, 0.19, 0.2])
def test_ill_conditioned_friction_takes_similar_numbers_of_products_on_ranks(distort):
    name = f"contact-patch/friction=coulomb/mu=0.2/feti=2/dim=3/distort={distort}"
    answers = [
        mb.solve(f"{name}/ratio=10/dual", "smalbe", tol=TOL, ranks=n) for n in (1, 2)
    ]
    assert all(answer.verdict == "verified" for answer in answers)
    products = [answer.record.counts["P_products"] for answer in answers]
    assert max(products) <= min(1.5 * min(products), 1000)


@pytest.mark.slow
def test_friction_on_metis_parts_has_the_same_displacement_on_ranks(tmp_path):
    toml = TOML.replace("[0, 0, -1e6]", "[2e5, 1e5, -1e6]")
    toml += 'friction = "coulomb"\nmu = 0.05\n'
    description = solid_blocks(tmp_path, TETRAHEDRA, toml)
    name = f"bodies:{description}/parts=4/dual"
    alone, *several = (mb.solve(name, "smalbe", tol=TOL, ranks=n) for n in (1, 2, 4))
    assert alone.record.quantities["slip"] > 0
    assert alone.record.quantities["stick"] > 0
    for answer in several:
        assert answer.verdict == "verified"
        assert answer.energy_bound <= 10 * TOL
        for quantity in ("energy", "max_von_mises", "multiplier_sum"):
            known = alone.record.quantities[quantity]
            assert answer.record.quantities[quantity] == pytest.approx(
                known, rel=10 * TOL
            )
        for state in ("open", "stick", "slip"):
            assert answer.record.quantities[state] == alone.record.quantities[state]


@pytest.mark.slow
@pytest.mark.parametrize("parts", [6, 20])
def test_a_disc_that_rolls_is_solved_on_ranks_as_by_one_process(tmp_path, parts):
    """Node-to-segment rows do not resist rolling, so the equality rows are
    dependent.
    """
    description = described(tmp_path)
    text = description.read_text().replace('"mortar"', '"nts"')
    held = '[[supports]]\npoint = "axis"\nfix = ["x"]\n'
    assert held in text
    description.write_text(text.replace(held, ""))
    case = mb.build(f"bodies:{description}/parts={parts}/dual")
    ranks, alone = (mb.solve(case, "smalbe", tol=TOL, ranks=n) for n in (2, 1))
    assert ranks.verdict == alone.verdict == "verified"
    assert ranks.energy_bound <= 1e-6
    assert ranks.record.objective == pytest.approx(alone.record.objective, rel=1e-8)


@pytest.mark.slow  # `problems/feti/test_distributed.py` tests the refusal of the form
def test_more_ranks_than_subdomains_are_declined():
    answer = mb.solve("membranes/S=1/n=2/dual", "smalbe", ranks=3)

    assert answer.verdict == "declined"
    assert "3 ranks for 2 subdomains" in answer.record.message


@pytest.mark.parametrize(
    ("case", "solver", "message"),
    [
        (
            "beam-ring/Nr=2/Nh=2/steps=1/dual",
            "smalbe",
            "cannot be distributed over ranks",
        ),
        pytest.param(
            CASE, "clarabel", "runs in one process only", marks=pytest.mark.slow
        ),
    ],
)
def test_qps_that_cannot_be_distributed_are_declined(case, solver, message):
    answer = mb.solve(case, solver, ranks=2)

    assert answer.verdict == "declined"
    assert message in answer.record.message


@pytest.mark.parametrize("count", ["0", "-1", "5000"])
def test_a_wrong_number_of_ranks_is_refused_in_one_line(capfd, count):
    assert (
        main(Registries(), ["solve", CASE, "--solver", "smalbe", "--mpi", count]) == 2
    )
    assert "expected a number of ranks, 1 to 4096" in capfd.readouterr().err


def test_a_missing_mpi_is_reported_before_anything_is_built(monkeypatch, capfd):
    monkeypatch.setattr(mpi, "find_spec", lambda name: None)

    assert main(Registries(), [*SOLVE, "--mpi", "2"]) == 2
    error = capfd.readouterr().err
    assert error.count("\n") == 1
    assert "pip install 'mortarbench[mpi]'" in error
    with pytest.raises(InputError, match="needs mpi4py"):
        mpi.ranks_asked(2, "ranks")


SUITE = """
name = "ranks"
tolerances = [1e-6]
repeats = 1
time_limit = 60
memory_limit = 4096
solvers = ["smalbe", "clarabel"]
ranks = [1, 2]
[[problems]]
family = "membranes"
forms = ["dual"]
params = { S = 2, n = 4 }
"""


@pytest.mark.slow
def test_a_suite_measures_solvers_with_ranks_on_each_number(tmp_path):
    suite = tmp_path / "ranks.toml"
    suite.write_text(SUITE)

    results = mb.run(suite, out=tmp_path / "out")

    found = {r.solver: r for r in results.records}
    asked = {name: (r.ranks, r.role) for name, r in found.items()}
    assert asked == {
        "smalbe": (1, ""), "smalbe ranks=2": (2, ""), "clarabel": (1, ""),
    }  # fmt: skip
    assert found["smalbe ranks=2"].verdict == "verified"
    assert found["smalbe ranks=2"].qp.startswith(DISTRIBUTED_DIGEST)


@dataclass
class Evaluated:
    """A case that ranks solved and evaluated twice: a single solve, and a suite."""

    known: mb.Case
    alone: mb.Answer
    out: Path
    record: Record


@pytest.fixture(scope="module")
def by_ranks(tmp_path_factory):
    """Solve twice on two ranks while no process can build the case."""
    folder = tmp_path_factory.mktemp("by_ranks")
    suite, case = folder / "ranks.toml", "beam-ring/Nr=2/Nh=2/steps=1/feti=2/dual"
    suite.write_text(
        SUITE.replace("[1, 2]", "[2]").replace("membranes", "beam-ring")
        .replace("S = 2, n = 4", "Nr = 2, Nh = 2, steps = 1, feti = 2")
        .replace('["smalbe", "clarabel"]', '["smalbe"]')
    )  # fmt: skip
    known = mb.build(case)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(type(known.id.family), "build", None)
        alone = mb.solve(case, "smalbe", tol=1e-6, ranks=2)
        (record,) = mb.run(suite, out=folder / "out").records
    return Evaluated(known, alone, folder / "out", record)


def test_ranks_evaluate_the_answer_and_no_process_builds_the_case(by_ranks):
    """Test suites and single solves; the ranks use the original family."""
    known, alone = by_ranks.known, by_ranks.alone

    for found in (alone.record, by_ranks.record):
        assert found.verdict == "verified"
        assert found.sizes == known.qp.sizes
        assert found.energy_bound < 1e-5
        assert found.quantities["dofs"] == 352
        assert found.build_seconds > 0
    assert not list((by_ranks.out / "cases").glob("*.npz"))
    quantities = known.quantities(alone.solution)
    assert alone.quantities["tip"] == pytest.approx(quantities["tip"], rel=1e-9)


def test_the_same_number_of_ranks_gives_the_same_bits(by_ranks):
    again = load_solution(by_ranks.out, by_ranks.record.vectors, Status.SOLVED)
    assert np.array_equal(by_ranks.alone.solution.x, again.x)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("ranks = [0]", "ranks = 0; expected a number of ranks"),
        ("ranks = [2, 2]", "expected distinct numbers"),
        ("ranks = 2", "ranks"),
    ],
)
def test_wrong_ranks_of_a_suite_are_refused(tmp_path, line, message):
    suite = tmp_path / "ranks.toml"
    suite.write_text(SUITE.replace("ranks = [1, 2]", line))

    with pytest.raises(InputError, match=message.replace("[", r"\[")):
        mb.run(suite, out=tmp_path / "out")


def test_a_suite_without_a_solver_for_ranks_is_refused(tmp_path):
    suite = tmp_path / "ranks.toml"
    suite.write_text(SUITE.replace('["smalbe", "clarabel"]', '["clarabel"]'))

    with pytest.raises(InputError, match="no solver runs on several ranks"):
        mb.run(suite, out=tmp_path / "out")


def test_a_sequence_on_several_ranks_is_refused(tmp_path):
    suite = tmp_path / "ranks.toml"
    suite.write_text(
        SUITE.replace(
            "{ S = 2, n = 4 }",
            '{ Nr = 4, steps = 2, step = [1, 2], feti = 4 }\nsequence = "step"',
        ).replace("membranes", "beam-ring")
    )

    with pytest.raises(InputError, match="a sequence runs in one process"):
        mb.run(suite, out=tmp_path / "out")


#: suite with the first of two load steps. A single process emits the QP, so a rank that
#: has its share is preparing or solving
LARGE = (
    SUITE.replace(
        "{ S = 2, n = 4 }", "{ Nr = 224, Nh = 128, steps = 2, step = 1, feti = 16 }"
    )
    .replace("ranks = [1, 2]", "ranks = [2]")
    .replace("membranes", "beam-ring")
)
WITH_A_SHARE = 110  #: MiB; a rank that waits for instructions uses 90 MiB
FAULTS = {
    "killed": (signal.SIGKILL, "", "crashed", r"rank 1 of 2 ranks ended: Killed"),
    "hung": (signal.SIGSTOP, "time_limit = 8", "time_limit", "killed after 8 s"),
    "greedy": (None, "memory_limit = 100", "memory_limit", "above the limit of 100"),
}


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS)
def test_a_rank_that_fails_ends_in_one_verdict_and_no_process_is_left(
    tmp_path, fault, monkeypatch
):
    sent, limit, verdict, message = FAULTS[fault]
    monkeypatch.setenv("FAULT", str(tmp_path))
    suite = tmp_path / "ranks.toml"
    key = limit.partition(" ")[0]
    lines = (line for line in LARGE.splitlines() if not key or key not in line)
    suite.write_text("\n".join([limit, *lines, ""]))
    command = ["-m", "mortarbench", "run", str(suite), "--solver", "smalbe ranks=2"]
    run = subprocess.Popen(
        [sys.executable, *command, "--out", str(tmp_path / "out")], cwd=ROOT,
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    if sent is not None:
        assert soon(lambda: busy_rank(tmp_path) or run.poll() is not None)
        os.kill(busy_rank(tmp_path)[-1], sent)
    assert run.wait() == 0

    (record,) = mb.load(tmp_path / "out").records
    assert record.verdict == verdict, record.message
    assert message.split("ranks")[0] in record.message
    assert soon(lambda: not processes(tmp_path))


def processes(mark):
    """List other processes of a test: IDs, commands and environments."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        try:
            environment = (entry / "environ").read_bytes().split(b"\0")
            command = (entry / "cmdline").read_bytes()
        except OSError:
            continue
        if f"FAULT={mark}".encode() in environment and int(entry.name) != os.getpid():
            found.append((int(entry.name), command, environment))
    return found


def resident_mib(pid):
    with suppress(OSError):
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
        return pages * os.sysconf("SC_PAGE_SIZE") / 2**20
    return 0.0


def busy_rank(mark):
    """Return the ID of rank 1 in a list; before rank 1 has its share of the QP, []."""
    return [
        pid
        for pid, command, environment in processes(mark)
        if b"PMI_RANK=1" in environment
        and b"worker" in command
        and resident_mib(pid) > WITH_A_SHARE
    ]
