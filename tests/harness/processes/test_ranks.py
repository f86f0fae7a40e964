"""Solves on several MPI ranks, compared with one process."""

from pathlib import Path

import numpy as np
import pytest

import mortarbench as mb
from mortarbench.harness.distributed import mpi
from mortarbench.harness.errors import InputError
from mortarbench.harness.files.store import load_solution
from mortarbench.harness.solution import Status
from mortarbench.registries import Registries
from tests.support.hexahedra import TETRAHEDRA
from tests.support.solid_blocks import TOML, solid_blocks

pytestmark = pytest.mark.together

TOL = 1e-6
#: one of the two membranes is held by contact alone
MEMBRANES = "membranes/S=2/n=4/dual"
#: each load step continues the previous one, and Coulomb's law is a fixed point
COULOMB = "beam-ring/Nr=2/Nh=1/steps=2/friction=coulomb/mu=0.3/feti=2/dual"
SLOW_CASES = (
    "beam-ring/Nr=4/Nh=3/steps=1/feti=4/glue=redundant/friction=tresca/bound=1e5/dual",
    "contact-patch/lower=4/upper=3/friction=coulomb/mu=0.3/feti=2/dim=3/dual",
    "contact-patch/ratio=1e-6/feti=2/dual",
    "greco/n=4/dim=3/depth=2/feti=2/dual",
    "hertz-cylinder/n=1/m=1/feti=9/friction=coulomb/mu=0.3/Q=0.5/dual",
    "hertz-sphere/n=1/against=sphere/Q=0.3/feti=2/dual",
    "cube-wall/n=4/feti=2/dual",
    "obstacle/n=10/shape=hemisphere/feti=3/dual",
    "plate/Sx=3/Sy=3/n=2/pattern=column/jump=10/glue=redundant/dual",
    "plate/Sx=3/Sy=3/n=2/dual",
)


def assert_equal_answers(alone, answer, ranks):
    """Compare the answers to one case on one process and on several ranks."""
    assert answer.verdict == alone.verdict == "verified"
    assert answer.record.qp == alone.record.qp
    assert answer.record.sizes == alone.record.sizes
    assert answer.record.ranks == answer.record.reported["ranks"] == ranks
    assert answer.record.solver == f"smalbe ranks={ranks}"
    assert answer.record.run_id != alone.record.run_id
    products = [a.record.counts["P_products"] for a in (alone, answer)]
    assert max(products) <= 1.02 * min(products)
    u, v = (alone.case.family_case.recover(a.solution) for a in (alone, answer))
    assert abs(u - v).max() <= 10 * TOL * abs(u).max()
    assert 0 < answer.energy_bound == pytest.approx(alone.energy_bound, rel=0.1)
    assert answer.energy_bound <= max(1e-5, 1.01 * alone.energy_bound)
    assert answer.record.objective == pytest.approx(alone.record.objective, rel=1e-9)
    assert answer.quantities.keys() == alone.quantities.keys()
    assert answer.quantities["energy"] == pytest.approx(alone.quantities["energy"])


@pytest.mark.parametrize("name", [MEMBRANES, COULOMB])
def test_two_ranks_have_the_answer_of_one_process(name):
    alone, answer = (mb.solve(name, "smalbe", tol=TOL, ranks=n) for n in (1, 2))
    assert_equal_answers(alone, answer, 2)


@pytest.mark.slow
@pytest.mark.parametrize("name", [MEMBRANES, COULOMB, *SLOW_CASES])
def test_all_numbers_of_ranks_have_the_answer_of_one_process(name):
    alone, *several = (mb.solve(name, "smalbe", tol=TOL, ranks=n) for n in (1, 2, 4))
    for ranks, answer in zip((2, 4), several, strict=True):
        assert_equal_answers(alone, answer, ranks)


@pytest.mark.slow
def test_ranks_read_a_mesh_in_parts(tmp_path):
    toml = TOML.replace("[0, 0, -1e6]", "[2e5, 1e5, -1e6]")
    toml += 'friction = "coulomb"\nmu = 0.05\n'
    description = solid_blocks(tmp_path, TETRAHEDRA, toml)
    name = f"bodies:{description}/parts=4/dual"
    alone, *several = (mb.solve(name, "smalbe", tol=TOL, ranks=n) for n in (1, 2, 4))
    assert alone.quantities["slip"] > 0
    for ranks, answer in zip((2, 4), several, strict=True):
        assert_equal_answers(alone, answer, ranks)


@pytest.mark.slow
def test_thirty_solves_on_four_ranks_do_not_diverge():
    """All solves on the same number of ranks have the same bits."""
    case = mb.build("beam-ring/Nr=4/Nh=3/steps=1/feti=2/dual")
    first, *others = (mb.solve(case, "smalbe", tol=TOL, ranks=4) for _ in range(30))
    assert first.verdict == "verified"
    for answer in others:
        assert answer.verdict == "verified"
        assert np.array_equal(answer.solution.x, first.solution.x)


#: solvers that need only products with P: one is smalbe under another name, the other
#: returns a point that is not a solution, and bribes the judge in its own process
FILE = """
from dataclasses import dataclass
import numpy as np
from mortarbench import Solution, Status
from mortarbench.harness.processes import ranks
from mortarbench.solvers.smalbe.solver import SMALBE

class Mine(SMALBE):
    pass

class Liar:
    def declines(self, qp):
        return None

    def prepare(self, qp, tol):
        x = 0 * (qp.P @ qp.q)
        ranks.evaluated = lambda *_: ({"status": "verified"}, [])
        return lambda: Solution(
            status=Status.SOLVED, x=x, y=0 * qp.b, z=0 * qp.h, z_box=x
        )

SOLVERS = {"mine": Mine(), "liar": Liar()}
"""


def test_new_ranks_judge_a_plug_in(tmp_path):
    (tmp_path / "mine.py").write_text(FILE)
    answer = mb.solve(
        MEMBRANES, "liar", tol=1e-6, ranks=2, plugins=[tmp_path / "mine.py"]
    )
    assert (answer.record.claimed, answer.verdict) == ("solved", "wrong")
    assert answer.record.reported["ranks"] == 2
    assert answer.record.qp == mb.solve(MEMBRANES, "smalbe", tol=1e-6).record.qp


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("membranes/S=1/n=2/dual", "3 ranks for 2 subdomains; expected at most"),
        ("beam-ring/Nr=2/Nh=2/steps=1/dual", "the case is not in subdomains; expected"),
    ],
)
def test_cases_that_ranks_cannot_divide_are_declined_before_any_rank_starts(
    name, message, monkeypatch
):
    monkeypatch.setattr(Registries, "worker_command", lambda *_: ["false"])
    answer = mb.solve(name, "smalbe", ranks=3)
    assert answer.verdict == "declined"
    assert answer.record.message.startswith(message)


@pytest.mark.parametrize("count", ["0", "-1", "5000"])
def test_a_wrong_number_of_ranks_is_refused_in_one_line(command, count):
    code, _, err = command("solve", MEMBRANES, "--solver", "smalbe", "--mpi", count)
    assert code == 2
    assert "expected a number of ranks, 1 to 4096" in err


def test_a_missing_mpi_is_reported_before_anything_is_built(monkeypatch, command):
    monkeypatch.setattr(mpi, "find_spec", lambda name: None)

    code, _, err = command("solve", MEMBRANES, "--solver", "smalbe", "--mpi", "2")
    assert (code, err.count("\n")) == (2, 1)
    assert "pip install 'mortarbench[mpi]'" in err
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
family = "beam-ring"
forms = ["dual"]
params = { Nr = 4, Nh = 2, steps = 3, step = [1, 2, 3], feti = 2 }
sequence = "step"
"""


def run_suite(folder: Path, text: str = SUITE, **options):
    suite = folder / "ranks.toml"
    suite.write_text(text)
    return mb.run(suite, out=folder / "out", **options)


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    """Run a sequence of three load steps on one process and on two ranks."""
    folder = tmp_path_factory.mktemp("path")
    return folder / "out", run_suite(folder).records


def test_a_suite_measures_solvers_of_operators_on_all_numbers_of_ranks(path):
    asked = {(r.solver, r.ranks) for r in path[1]}
    assert asked == {("smalbe", 1), ("smalbe ranks=2", 2), ("clarabel", 1)}
    assert {r.status for r in path[1] if r.solver != "clarabel"} == {"verified"}


def test_a_sequence_of_load_steps_is_warm_on_ranks(path):
    by_step = {
        n: sorted(
            (r for r in path[1] if r.ranks == n and r.solver.startswith("smalbe")),
            key=lambda r: r.params["step"],
        )
        for n in (1, 2)
    }
    products = {n: [r.counts["P_products"] for r in rs] for n, rs in by_step.items()}
    assert sum(products[2]) == pytest.approx(sum(products[1]), rel=0.02)
    # a warm solve needs fewer products than the first
    assert max(products[2][1:]) < products[2][0]
    for one, two in zip(*by_step.values(), strict=True):
        assert one.qp == two.qp
        assert two.objective == pytest.approx(one.objective, rel=1e-9)
        assert two.energy_bound <= 1e-5


def test_the_same_number_of_ranks_gives_the_same_bits(path):
    """A suite and a single solve on two ranks; the first load step has no history."""
    out, records = path
    (record,) = (r for r in records if r.ranks == 2 and r.params["step"] == 1)
    known = load_solution(out, record.vectors, Status.SOLVED)
    answer = mb.solve(record.case, "smalbe", tol=record.tol, ranks=2)
    assert np.array_equal(answer.solution.x, known.x)


@pytest.mark.slow
def test_new_ranks_judge_a_sequence_of_a_plug_in(tmp_path):
    (tmp_path / "mine.py").write_text(FILE)
    text = SUITE.replace('"smalbe", "clarabel"', '"mine"').replace("[1, 2]", "[2]", 1)
    records = run_suite(tmp_path, text, plugins=[tmp_path / "mine.py"]).records
    assert [r.status for r in records] == ["verified"] * 3
    assert all(r.energy_bound <= 1e-5 for r in records)


@pytest.mark.slow
def test_a_suite_declines_cases_with_fewer_subdomains_than_ranks(tmp_path):
    text = SUITE.replace('"smalbe", "clarabel"', '"smalbe"').replace("[1, 2]", "[3]", 1)
    head, _, _ = text.partition("[[problems]]")
    text = head + '[[problems]]\nfamily = "membranes"\nforms = ["dual"]\n'
    text += "params = { S = [1, 2], n = 2 }\n"
    found = {r.params["S"]: r for r in run_suite(tmp_path, text).records}
    assert found[1].status == "declined"
    assert "3 ranks for 2 subdomains" in found[1].message
    assert found[2].status == "verified"


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("ranks = [0]", "ranks = 0; expected a number of ranks"),
        ("ranks = [2, 2]", "expected distinct numbers"),
        ("ranks = 2", "ranks"),
    ],
)
def test_wrong_ranks_of_a_suite_are_refused(tmp_path, line, message):
    with pytest.raises(InputError, match=message):
        run_suite(tmp_path, SUITE.replace("ranks = [1, 2]", line))


def test_a_suite_without_a_solver_for_ranks_is_refused(tmp_path):
    text = SUITE.replace('["smalbe", "clarabel"]', '["clarabel"]')
    with pytest.raises(InputError, match="every solver needs the entries of P"):
        run_suite(tmp_path, text)
