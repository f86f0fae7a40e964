"""Every reader of text takes or refuses a damaged one: no traceback, no hang."""

import json
import random
import warnings

import pytest

from harness import InputError
from harness.names import parse
from harness.results.folder import environment_of
from harness.results.journal import read_journal
from harness.suite.suite import load_suite
from mortarbench.cli.main import main
from mortarbench.registries import Registries
from problems import PROBLEMS
from problems.contact.bodies import assembled
from problems.models.description import described_bodies
from reports.data.evidence import read_evidence
from reports.folder import compose, write_report
from solvers import SOLVERS
from tests.support import damaged_texts, synthetic_results

FEW, MANY = 30, 1000
COUNTS = pytest.mark.parametrize(
    "count", [FEW, pytest.param(MANY, marks=pytest.mark.slow)]
)

SUITE = """\
name = "demo"
tolerances = [1e-6, 1e-3]
repeats = 3
time_limit = 60
memory_limit = 4096.0
null_arm = "osqp"
precision = 0.1
solvers = ["osqp", { name = "clarabel", label = "few", options = { max_iter = 200 } }]

[[problems]]
family = "beam-ring"
forms = ["primal", "dual"]
params = { Nr = [4, 12], Nh = [3, 6], step = [1, 5, 10] }
zip = [["Nr", "Nh"]]

[[problems]]
family = "hertz-plane"
params = { n = 4, load = [1.0, 2.5] }
sequence = "load"
"""
BODIES = """\
mesh = "two.msh"
plane = "strain"
contact = "nts"
basis = "dual"
steps = 10
relin = 1
units = { length = 2.0, force = 1e8 }
[[bodies]]
name = "low"
E = 200e9
nu = 0.3
[[bodies]]
name = "high"
E = 1e9
nu = 0.25
[[supports]]
boundary = "floor"
fix = ["x", "y"]
[[loads]]
boundary = "top"
traction = [0.0, -1e6]
[[contacts]]
slave = "under"
master = "over"
"""
MESH = """\
$MeshFormat
2.2 0 8
$EndMeshFormat
$PhysicalNames
6
1 1 "floor"
1 2 "over"
1 3 "under"
1 4 "top"
2 5 "low"
2 6 "high"
$EndPhysicalNames
$Nodes
8
1 0 0 0
2 1 0 0
3 1 1 0
4 0 1 0
5 0 1.1 0
6 1 1.1 0
7 1 2 0
8 0 2 0
$EndNodes
$Elements
6
1 1 2 1 1 1 2
2 1 2 2 2 3 4
3 1 2 3 3 5 6
4 1 2 4 4 7 8
5 3 2 5 5 1 2 3 4
6 3 2 6 6 5 6 7 8
$EndElements
"""
NAMES = (
    "beam-ring/Nr=30/Nh=15/step=10/dual", "hertz-plane/n=4/load=2.5/primal",
    "obstacle/dim=2/n=20/dual-bounds", "contact-patch/ratio=1.5/lower=3/dual",
    "bodies:press.toml/steps=2/primal", "file:a.npz",
)  # fmt: skip
NESTED = ("params", "sizes", "options", "counts", "reported", "quantities")
ENVIRONMENT = {
    "digest": "8c2f9a56e00f", "now": {"load": 0.1, "time": "2026-11-21"},
    "machine": {"cpu": "a processor", "usable_cores": 2, "memory_mib": 8192},
    "versions": {"numpy": "2.0"}, "plugins": ["a.py"],
    "threads": [{"library": "openblas", "threads": 1}], "variables": {},
}  # fmt: skip


def tried(text, read):
    """Read one text: whether it was taken; anything but an InputError is a fault."""
    try:
        with damaged_texts.no_hang(), warnings.catch_warnings():
            warnings.simplefilter("error")
            read()
    except InputError:
        return False
    except BaseException as e:
        e.add_note(f"of the text {text!r:.3000}")
        raise
    return True


def written(path, text):
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    return path


@COUNTS
def test_a_damaged_suite_is_read_or_refused(tmp_path, count):
    chance, path = random.Random(count), tmp_path / "suite.toml"
    for _ in range(count):
        text = damaged_texts.damaged(SUITE, chance)
        written(path, text)
        tried(text, lambda: load_suite(path, PROBLEMS, SOLVERS))


@COUNTS
def test_a_damaged_description_of_bodies_is_read_or_refused(tmp_path, count):
    (tmp_path / "two.msh").write_text(MESH)
    chance, path = random.Random(count), tmp_path / "bodies.toml"
    path.write_text(BODIES)
    assert assembled(described_bodies(path, "strain")).K.shape == (16, 16)
    for _ in range(count):
        text = damaged_texts.damaged(BODIES, chance)
        written(path, text)
        tried(text, lambda: assembled(described_bodies(path, "strain")))


@COUNTS
def test_a_damaged_name_of_a_case_is_read_or_refused(count):
    chance = random.Random(count)

    def read(text):
        name = parse(text, PROBLEMS)
        assert parse(str(name), PROBLEMS) == name

    for _ in range(count):
        text = damaged_texts.damaged(chance.choice(NAMES), chance)
        tried(text, lambda text=text: read(text))


def lines(count, chance):
    """Journal lines with odd values, each under a run_id of its own."""
    sound = [json.loads(r.to_json()) for r in synthetic_results.records(3, 4, 2)]
    for i in range(count):
        row = chance.choice(sound) | {"run_id": f"{i:012x}"}
        part = chance.choice((*NESTED, "message", "claimed", "started", "node", ""))
        changed = damaged_texts.distorted({part: row[part]} if part else row, chance)
        row |= changed
        text = json.dumps(row)
        yield damaged_texts.damaged(text, chance) if chance.random() < 0.3 else text


@COUNTS
def test_odd_lines_of_a_journal_are_refused_or_reported(tmp_path, count):
    journal = tmp_path / "journal" / "odd.jsonl"
    journal.parent.mkdir()
    taken = {}
    for line in lines(count, random.Random(count)):
        text = line.replace("\n", " ") + "\n"
        written(journal, text)
        if tried(text, lambda: read_journal(tmp_path)):
            taken[read_journal(tmp_path)[0].run_id] = text
    assert count / 10 < len(taken) < count
    written(journal, "".join(taken.values()))
    (tmp_path / "environment.json").write_text(json.dumps(ENVIRONMENT))

    assert tried("all that were taken", lambda: compose(read_evidence(tmp_path)))
    assert tried("", lambda: write_report(tmp_path, ("csv", "parquet")))


@COUNTS
def test_an_odd_environment_is_refused_or_reported(tmp_path, count):
    chance = random.Random(count)
    synthetic_results.write(tmp_path, 1, 1, 1)
    path = tmp_path / "environment.json"
    for i in range(count):
        text = json.dumps(
            damaged_texts.distorted(ENVIRONMENT, chance), ensure_ascii=False
        )
        text = damaged_texts.damaged(text, chance) if chance.random() < 0.3 else text
        written(path, text)
        tried(text, lambda: environment_of(tmp_path, "8c2f9a56e00f"))
        taken = tried(text, lambda: read_evidence(tmp_path))
        if taken and i % 10 == 0:
            assert tried(text, lambda: compose(read_evidence(tmp_path)))


@COUNTS
def test_damaged_values_on_the_command_line_are_taken_or_refused_in_a_line(
    tmp_path, monkeypatch, capsys, count
):
    monkeypatch.chdir(tmp_path)
    synthetic_results.write(tmp_path / "run", 1, 1, 1)
    commands = [
        ["report", "nowhere", "--factor", "10"], ["replay", "run", "68bf42c63dd7"],
        ["validate", "nowhere", "--budget", "30"], ["list", "problems"],
        ["run", "demo.toml", "--time-limit", "60"], ["report", "run", "--format", "md"],
        ["solve", "beam-ring/Nr=4/dual", "--solver", "osqp", "--tol", "2"],
        ["export", "beam-ring/dual", "a.txt"], ["run", "nowhere", "--case", "*"],
    ]  # fmt: skip
    chance, registries = random.Random(count), Registries()
    for _ in range(count // 3):
        argv = [*chance.choice(commands)]
        at = chance.randrange(1, len(argv))
        argv[at] = damaged_texts.damaged(argv[at], chance).replace("\x00", "")
        if argv in commands or "\n" in argv[at] or "-h" in argv[at]:
            continue
        with damaged_texts.no_hang():
            assert main(registries, argv) == 2, argv
        message = capsys.readouterr().err
        assert message.count("\n") == 1, argv
        assert len(message) < 1500
