"""The command line: what it prints where, and with which exit code."""

import io
import json
import subprocess
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from harness import QP, Case, Fields, InputError, Solution, Status, no_rows
from harness.cli import main
from harness.journal import read_journal
from harness.progress import shown_on
from harness.qpfile import load_qp
from harness.workbench import Workbench


@dataclass(frozen=True)
class Well:
    """A parabola over a half line. Nothing more."""

    name: str = "well"
    defaults: dict = field(default_factory=lambda: {"n": 3, "depth": 1})
    forms: tuple = ("primal", "dual")

    def check(self, params):
        if params["n"] < 1:
            raise InputError(f"well: n={params['n']} must be at least 1")

    def build(self, form, params, reference):
        """min ½|x|² - depth·Σx over x ≥ 0: x = depth, objective -n·depth²/2."""
        n, depth = params["n"], params["depth"]
        if depth == 13:
            raise KeyboardInterrupt
        if depth == 99:
            raise ZeroDivisionError("a fault of ours")
        qp = QP(
            P=np.eye(n), q=np.full(n, -float(depth)),
            A=no_rows(n), b=np.zeros(0), G=no_rows(n), h=np.zeros(0),
            lb=np.zeros(n), ub=np.full(n, np.inf),
        )  # fmt: skip
        return Case(
            qp=qp,
            recover=lambda s: s.x,
            quantities=lambda s: {"energy": 2 * qp.objective(s.x), "tip": s.x[:2]},
            fields=self.fields if form == "primal" else None,
            scale=2.0,
        )

    def fields(self, s):
        return Fields(
            points=np.zeros((4, 2)),
            cells=np.array([[0, 1, 2, 3]]),
            bodies=np.zeros(1),
            displacement=np.zeros((4, 2)),
        )


@dataclass(frozen=True)
class Exact:
    """Divides by a diagonal. Only for wells."""

    factor: float = 1.0
    reason: str | None = None

    def declines(self, qp):
        return self.reason

    def prepare(self, qp, tol):
        zeros = dict(y=np.zeros(0), z=np.zeros(0), z_box=0 * qp.q)
        return lambda: Solution(status=Status.SOLVED, x=-self.factor * qp.q, **zeros)


@dataclass(frozen=True)
class Lost(Exact):
    def prepare(self, qp, tol):
        return lambda: Solution.without_point(qp, Status.FAILED, "nowhere to go")


@dataclass(frozen=True)
class Lax(Exact):
    """As good as asked for. Not better."""

    def prepare(self, qp, tol):
        return Exact(factor=1 + tol).prepare(qp, tol)


SOLVERS = {
    "exact": Exact(),
    "lax": Lax(),
    "liar": Exact(factor=1.5),
    "picky": Exact(reason="never on a Monday"),
    "lost": Lost(),
}


def paper(out, quick, say):
    say("Figure 1")
    return [out / f"index-{quick}.html", out / "figure1.pdf"]


@pytest.fixture
def workbench(tmp_path):
    suites = tmp_path / "suites"
    suites.mkdir()
    (suites / "tiny.toml").write_text(
        "# For tests.\nname = 'tiny'\nsolvers = ['exact']\n"
        "[[problems]]\nfamily = 'well'\n"
    )
    return Workbench(
        families={"well": Well()},
        solvers=SOLVERS,
        reference=lambda qp: Exact().prepare(qp, 0.0)(),
        report=lambda folder, formats: [folder / f"index.{f}" for f in formats],
        plot=lambda fields, path: path.write_bytes(b"picture"),
        vtu=lambda fields, path: path.write_bytes(b"grid"),
        paper=paper,
        suites=suites,
    )


@pytest.fixture
def cli(workbench, capsys, monkeypatch, tmp_path):
    """Run a command line in an empty folder; returns its code, stdout and stderr."""
    monkeypatch.chdir(tmp_path)

    def cli(*argv):
        code = main(workbench, [str(word) for word in argv])
        streams = capsys.readouterr()
        return code, streams.out, streams.err

    return cli


def test_problems_are_listed_with_defaults_and_forms(cli):
    code, out, _ = cli("list", "problems")

    assert code == 0
    assert (
        out == "well  A parabola over a half line.  n=3 depth=1  primal | dual\n"
    )  # one sentence of two


def test_solvers_are_listed_one_line_each(cli):
    _, out, _ = cli("list", "solvers")

    assert [line.split()[0] for line in out.splitlines()] == list(SOLVERS)
    assert out.startswith("exact  Divides by a diagonal.  factor=1.0 reason=None\n")
    assert "Lost(" not in out  # no sentence, only what dataclass makes up


def test_suites_are_listed_with_their_purpose(cli):
    assert cli("list", "suites") == (0, "tiny  For tests.\n", "")


@pytest.mark.parametrize(
    ("what", "expected"),
    [
        ("problems", {"name": "well", "forms": ["primal", "dual"],
                      "defaults": {"n": 3, "depth": 1},
                      "description": "A parabola over a half line."}),
        ("solvers", {"name": "exact", "options": {"factor": 1.0, "reason": None},
                     "description": "Divides by a diagonal."}),
    ],
)  # fmt: skip
def test_lists_are_one_json_array_for_machines(cli, what, expected):
    _, out, _ = cli("list", what, "--json")

    assert json.loads(out)[0] == expected


def test_a_verified_solve_exits_with_0_and_shows_si_units(cli):
    code, out, err = cli("solve", "well/n=2/primal", "--solver", "exact")

    rows = dict(line.split("  ", 1) for line in out.splitlines())
    assert (code, err) == (0, "")
    assert rows["case"].strip() == "well/n=2/primal"
    assert rows["status"].strip() == "verified (claimed solved)"
    assert rows["energy"].strip() == "-2 J/m"
    assert rows["tip"].strip() == "(1, 1) m"


def test_solve_prints_one_json_object_with_canonical_name_and_quantities(cli):
    code, out, _ = cli(
        "solve", "well/depth=1/n=2/primal", "--solver", "exact", "--tol", "1e-6",
        "--json",
    )  # fmt: skip

    record = json.loads(out)
    assert code == 0
    assert out.count("\n") == 1
    assert record["case"] == "well/n=2/primal"
    assert record["params"] == {"n": 2, "depth": 1}
    assert record["options"] == {"factor": 1.0, "reason": None}
    assert record["sizes"]["variables"] == 2
    assert (record["tol"], record["status"]) == (1e-6, "verified")
    assert record["objective"] == pytest.approx(-1)
    assert record["quantities"] == {"energy": pytest.approx(-2), "tip": [1.0, 1.0]}
    assert record["environment"]


def test_a_refuted_claim_exits_with_1(cli):
    code, out, _ = cli("solve", "well/primal", "--solver", "liar", "--json")

    record = json.loads(out)
    assert (code, record["claimed"], record["status"]) == (1, "solved", "wrong")


def test_the_tolerance_asked_for_decides_the_verdict(cli):
    command = ("solve", "well/primal", "--solver", "liar", "--tol")

    assert [cli(*command, tol)[0] for tol in ("0.01", "0.9")] == [1, 0]


def test_a_solver_is_told_the_tolerance(cli):
    _, out, _ = cli(
        "solve", "well/n=1/primal", "--solver", "lax", "--tol", "0.1", "--json"
    )

    assert json.loads(out)["quantities"]["tip"] == [pytest.approx(1.1)]


def test_a_solver_that_declines_exits_with_1_and_its_reason_on_stderr(cli):
    assert cli("solve", "well/primal", "--solver", "picky") == (
        1, "", "mortarbench: picky declines well/primal: never on a Monday\n"
    )  # fmt: skip


def test_a_picture_is_drawn_of_a_point_and_of_nothing_else(cli, tmp_path):
    picture = tmp_path / "a.png"
    drawn = cli("solve", "well/primal", "--solver", "exact", "--plot", picture)
    lost = cli("solve", "well/primal", "--solver", "lost", "--plot", tmp_path / "b.png")

    assert drawn[0] == 0
    assert picture.read_bytes() == b"picture"
    assert lost[0] == 1
    assert "no picture: lost returned no point" in lost[2]
    assert not (tmp_path / "b.png").exists()


def test_an_exported_qp_is_the_emitted_one_and_says_whose_it_is(cli, tmp_path):
    file = tmp_path / "well.npz"
    code, out, _ = cli("export", "well/depth=4/n=2/dual", file)

    qp, meta = load_qp(file)
    assert (code, out) == (0, f"{file}\n")
    assert qp.q.tolist() == [-4, -4]
    assert meta["name"] == "well/n=2/depth=4/dual"
    assert (meta["scale"], meta["constant"]) == (2.0, 0.0)


def test_report_names_the_files_that_it_wrote(cli):
    code, out, _ = cli("report", "folder", "--format", "md,tex")

    assert (code, out.splitlines()) == (0, ["folder/index.md", "folder/index.tex"])
    assert len(cli("report", "folder")[1].splitlines()) == 4


def test_doctor_describes_the_machine(cli):
    code, out, _ = cli("doctor")

    assert code == 0
    assert "numpy" in out


def test_an_interrupt_exits_with_130_and_one_line(cli):
    code, out, err = cli("solve", "well/depth=13/primal", "--solver", "exact")

    assert (code, out) == (130, "")
    assert err.startswith("mortarbench: interrupted")
    assert err.count("\n") == 1


def test_a_fault_of_ours_exits_with_3_and_a_traceback(cli):
    code, out, err = cli("solve", "well/depth=99/primal", "--solver", "exact")

    assert (code, out) == (3, "")
    assert "Traceback" in err
    assert "ZeroDivisionError: a fault of ours" in err


SOLVE = ("solve", "well/primal", "--solver", "exact")
WRONG = {
    "no command": ((), "the following arguments are required: COMMAND; usage: morta"),
    "unknown command": (("rnu",), "'rnu' (choose from"),
    "unknown list": (("list", "sovlers"), "'sovlers' (choose from"),
    "unknown option": (("run", "tiny", "--repeat", "3"), "unknown argument '--repeat'"),
    "no integer": (
        ("run", "tiny", "--repeats", "x"),
        "argument --repeats: invalid int",
    ),
    "no solver": (("solve", "well/primal"), "arguments are required: --solver"),
    "unknown solver": (
        ("solve", "well/primal", "--solver", "exat"),
        "unknown solver 'exat'; did you mean 'exact'? known: exact, lax, liar, lost, p",
    ),
    "unknown family": (
        ("solve", "wel/primal", "--solver", "exact"),
        "unknown family 'wel'; did you mean 'well'? known: well",
    ),
    "unknown key": (
        ("solve", "well/dept=2/primal", "--solver", "exact"),
        "well: unknown key 'dept'; did you mean 'depth'? known: depth, n",
    ),
    "bad value": (
        ("export", "well/n=two/primal", "a.npz"),
        "well: n='two' is no integer",
    ),
    "value out of range": (
        ("solve", "well/n=0/primal", "--solver", "exact"),
        "well: n=0 must be at least 1",
    ),
    "malformed case": (
        ("export", "well/n/primal", "a.npz"),
        "well: malformed part 'n'; expected key=value",
    ),
    "no form": (("export", "well/n=2", "a.npz"), "expected one of primal, dual"),
    "tolerance": ((*SOLVE, "--tol", "2"), "--tol = 2.0; expected a number between 0"),
    "picture format": (
        (*SOLVE, "--plot", "a.txt"),
        "unknown format '.txt'; expected .",
    ),
    "picture nowhere": (
        (*SOLVE, "--plot", "no/a.png"),
        "no/a.png: no folder no; expec",
    ),
    "nothing to draw": (
        ("solve", "well/dual", "--solver", "exact", "--plot", "a.png"),
        "well/dual has no bodies to draw; leave out --plot",
    ),
    "export format": (
        ("export", "well/dual", "a.parquet"),
        "'.parquet'; expected .npz or .mat",
    ),
    "report format": (
        ("report", "folder", "--format", "md,htm"),
        "--format: unknown format 'htm'; did you mean 'html'? known: csv, html",
    ),
    "missing plug-in": (
        (*SOLVE, "--plugin", "gone.py"),
        "gone.py: no such file; expect",
    ),
    "broken plug-in": (
        (*SOLVE, "--plugin", "broken.py"),
        "broken.py: failed to import: ModuleNotFoundError: No module named 'noth",
    ),
    "plug-in takes a name": (
        (*SOLVE, "--plugin", "taken.py"),
        "taken.py: solver 'exact' of the plug-in exists; rename the new one",
    ),
    "missing suite": (
        ("run", "gone.toml"),
        "gone.toml: no such file; expected a suite",
    ),
    "unknown suite": (
        ("run", "tinny"),
        "unknown suite 'tinny'; did you mean 'tiny'? known: tiny",
    ),
    "malformed suite": (
        ("run", "bad.toml"),
        "bad.toml: line 1, column 8: Invalid value",
    ),
    "wrong suite": (
        ("run", "zero.toml"),
        "zero.toml: repeats = 0; expected an integer of at least 1",
    ),
    "repeats": (
        ("run", "tiny", "--repeats", "0"),
        "--repeats = 0; expected an integer",
    ),
    "time limit": (
        ("run", "tiny", "--time-limit", "0"),
        "--time-limit = 0.0; expected ",
    ),
    "solver of run": (
        ("run", "tiny", "--solver", "exat"),
        "--solver: unknown solver 'ex",
    ),
    "folder of paper": (
        ("paper", "--out", "bad.toml"),
        "--out bad.toml: File exists; expected a folder",
    ),
    "pattern of run": (
        ("run", "tiny", "--case", "*/duel"),
        "--case '*/duel' matches none of the 2 cases of suite 'tiny'; the first is",
    ),
}


@pytest.mark.parametrize(("argv", "message"), WRONG.values(), ids=WRONG.keys())
def test_wrong_input_is_one_line_with_the_remedy_and_exits_with_2(
    cli, tmp_path, argv, message
):
    (tmp_path / "broken.py").write_text("import nothing_of_that_name")
    (tmp_path / "bad.toml").write_text("name = \n")
    (tmp_path / "zero.toml").write_text("repeats = 0\nname = 'a'\n" + SUITE)
    (tmp_path / "taken.py").write_text(
        "from types import SimpleNamespace as S\n"
        "SOLVERS = {'exact': S(declines=None, prepare=None)}"
    )

    code, out, err = cli(*argv)

    assert (code, out) == (2, "")
    assert err.startswith("mortarbench: ")
    assert err.endswith("\n")
    assert err.count("\n") == 1
    assert message in err
    assert not (tmp_path / "out").exists()


SUITE = "solvers = ['exact']\n[[problems]]\nfamily = 'well'\n"


def test_paper_says_what_it_measures_and_prints_where_the_page_is(cli):
    assert cli("paper") == (
        0,
        "out/paper/index-False.html\n",
        "mortarbench: Figure 1\n",
    )
    assert cli("paper", "--quick", "--out", "a")[1] == "a/index-True.html\n"


def test_help_is_no_error(cli, capsys):
    with pytest.raises(SystemExit) as e:
        cli("run", "--help")

    assert e.value.code == 0
    assert "--memory-limit MIB" in capsys.readouterr().out


PLUGIN = """
from dataclasses import dataclass
import numpy as np
from harness import QP, Case, Solution, Status, no_rows

@dataclass(frozen=True)
class Pit:
    name: str = "pit"
    defaults = {"n": 3}
    forms = ("primal",)
    def build(self, form, params, reference):
        n = params["n"]
        qp = QP(P=np.eye(n), q=-np.ones(n), A=no_rows(n), b=np.zeros(0),
                G=no_rows(n), h=np.zeros(0), lb=np.zeros(n), ub=np.full(n, np.inf))
        return Case(qp=qp, recover=lambda s: s.x, quantities=lambda s: {})

@dataclass(frozen=True)
class Times:
    factor: float = 1.0
    def declines(self, qp):
        return None
    def prepare(self, qp, tol):
        zeros = dict(y=np.zeros(0), z=np.zeros(0), z_box=0 * qp.q)
        return lambda: Solution(status=Status.SOLVED, x=-self.factor * qp.q, **zeros)

SOLVERS = {"times": Times()}
PROBLEMS = {"pit": Pit()}
"""


@pytest.fixture
def pit(tmp_path):
    (tmp_path / "plug.py").write_text(PLUGIN)
    (tmp_path / "pit.toml").write_text(
        "name = 'pit'\nrepeats = 2\n"
        "[[solvers]]\nname = 'times'\nlabel = 'twice'\noptions = { factor = 2 }\n"
        "[[solvers]]\nname = 'times'\n"
        "[[solvers]]\nname = 'times'\nlabel = 'near'\noptions = { factor = 1.0001 }\n"
        "[[problems]]\nfamily = 'pit'\nparams = { n = [2, 3] }\n"
    )
    return ("run", "pit.toml", "--plugin", "plug.py")


def test_a_run_measures_in_workers_and_ends_in_a_summary_and_a_page(cli, pit):
    code, out, err = cli(*pit)

    header, *rows, page = out.splitlines()
    assert code == 0
    assert header.split()[:3] == ["solver", "measured", "claimed"]
    assert [row.split() for row in rows] == [
        ["twice", "4", "4", "0", "4", "0", "0"],
        ["times", "4", "4", "4", "0", "0", "0"],
        ["near", "4", "4", "0", "4", "0", "0"],
    ]
    assert page == "out/pit/index.html"
    assert err.splitlines()[0] == "12 measurements"
    assert err.splitlines()[-1].startswith("12/12 ")
    statuses = {(r.solver, r.status) for r in read_journal(Path("out/pit"))}
    assert statuses == {
        ("times", "verified"), ("twice", "wrong"), ("near", "inaccurate")
    }  # fmt: skip


def test_a_run_narrowed_is_a_part_of_the_whole_that_continues_it(cli, pit):
    narrow = ("--solver", "twice", "--case", "pit/n=2/*", "--repeats", "1")
    cli(*pit, "--out", "here", *narrow)
    first = read_journal(Path("here"))
    cli(*pit, "--out", "here")
    both = read_journal(Path("here"))

    assert [(r.solver, r.case) for r in first] == [("twice", "pit/n=2/primal")]
    assert len(both) == 12
    assert both[0] == first[0]


def test_a_fresh_run_forgets_what_the_folder_held(cli, pit):
    narrow = ("--case", "pit/n=2/*", "--repeats", "1", "--out", "here")
    for solver in ("times", "twice"):
        cli(*pit, *narrow, "--solver", solver, "--fresh")

    assert [r.solver for r in read_journal(Path("here"))] == ["twice"]


def test_on_a_terminal_a_run_is_a_bar_that_says_what_it_does(monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    terminal = io.StringIO()
    terminal.isatty = lambda: True

    with shown_on(terminal) as progress:
        progress.start(7)
        progress.say("osqp on [red]/primal")
        progress.advance(None)

    assert "1/7" in terminal.getvalue()
    assert "osqp on [red]/primal" in terminal.getvalue()


def test_the_module_is_the_same_command_from_any_folder(tmp_path):
    done = subprocess.run(
        [sys.executable, "-m", "harness", "list", "suites"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )

    assert [line.split()[0] for line in done.stdout.splitlines()] == [
        "demo", "scaling", "smoke"
    ]  # fmt: skip


def test_the_workbench_is_not_changed_by_plugins(workbench, tmp_path):
    (tmp_path / "plug.py").write_text(PLUGIN)
    before = replace(workbench)

    extended = workbench.with_files([tmp_path / "plug.py"])

    assert set(extended.solvers) == {*SOLVERS, "times"}
    assert set(extended.families) == {"well", "pit"}
    assert workbench == before
