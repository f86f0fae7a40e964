"""Output, output streams and exit codes of the command line."""

import json
import os
import subprocess
import sys
from functools import partial
from importlib.metadata import version
from pathlib import Path

import numpy as np
import pytest

from mortarbench.cli.main import COMMANDS, command_parser, main
from mortarbench.harness.files.qpfile import load_qp
from mortarbench.harness.registry import load_plugin
from mortarbench.harness.results.journal import Journal, read_journal
from mortarbench.progress import display_on
from mortarbench.registries import Registries
from tests.support import TOY_PROBLEM, WRITE_REPORT
from tests.support.toy_registries import toy_registries

SOLVERS = load_plugin(TOY_PROBLEM).solvers
FAMILIES = load_plugin(TOY_PROBLEM).problems


def report(folder, formats, factor):
    name = "index" if factor == 10 else f"index-{factor:g}"
    return [folder / f"{name}.{f}" for f in formats], []


@pytest.fixture
def registries(tmp_path):
    suites = tmp_path / "suites"
    suites.mkdir()
    (suites / "tiny.toml").write_text(
        "# For tests.\nname = 'tiny'\nsolvers = ['exact']\n"
        "[[problems]]\nfamily = 'well'\n"
    )
    return toy_registries(lambda qp: SOLVERS["exact"].prepare(qp, 0.0)(), suites=suites)


@pytest.fixture
def cli(registries, command, monkeypatch):
    """Run a command line with the toy problem in an empty folder."""
    monkeypatch.setattr(WRITE_REPORT, report)
    return partial(command, registries=registries)


def test_problems_are_listed_with_defaults_and_forms(cli):
    code, out, _ = cli("list", "problems")

    assert code == 0
    assert (
        out == "well  Separable quadratics over x ≥ 0.  n=3 depth=1  primal | dual\n"
    )  # first sentence of the docstring


def test_solvers_are_listed_one_line_each(cli):
    _, out, _ = cli("list", "solvers")

    assert [line.split()[0] for line in out.splitlines()] == list(SOLVERS)
    first = " ".join(out.splitlines()[0].split())
    assert first == "exact Solver for P = I and inactive bounds. factor=1.0 reason=None"
    assert "Lost(" not in out  # dataclass wrote this as the docstring


@pytest.mark.parametrize(
    ("what", "expected"),
    [
        ("problems", {"name": "well", "forms": ["primal", "dual"],
                      "defaults": {"n": 3, "depth": 1},
                      "keys": {"n": "int, at least 1: unknowns", "depth": "int"},
                      "description": "Separable quadratics over x ≥ 0."}),
        ("solvers", {"name": "exact", "options": {"factor": 1.0, "reason": None},
                     "description": "Solver for P = I and inactive bounds."}),
    ],
)  # fmt: skip
def test_lists_can_be_printed_as_one_json_array(cli, what, expected):
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
    assert record["quantities"] == {
        "dofs": 2, "energy": pytest.approx(-2), "tip": [1.0, 1.0]
    }  # fmt: skip
    assert record["environment"]


def test_a_refuted_claim_exits_with_1(cli):
    code, out, _ = cli("solve", "well/primal", "--solver", "liar", "--json")

    record = json.loads(out)
    assert (code, record["claimed"], record["status"]) == (1, "solved", "wrong")


def test_the_requested_tolerance_determines_the_verdict(cli):
    command = ("solve", "well/primal", "--solver", "near", "--tol")

    assert [cli(*command, tol)[0] for tol in ("1e-6", "1e-2")] == [1, 0]


def test_a_solver_that_declines_exits_with_1_and_its_reason_on_stderr(cli):
    assert cli("solve", "well/primal", "--solver", "picky") == (
        1, "", "mortarbench: picky declines well/primal: never on a Monday\n"
    )  # fmt: skip


def test_a_picture_is_drawn_only_if_there_is_a_point(cli, tmp_path):
    picture = tmp_path / "a.png"
    drawn = cli("solve", "well/primal", "--solver", "exact", "--plot", picture)
    lost = cli("solve", "well/primal", "--solver", "lost", "--plot", tmp_path / "b.png")

    assert drawn[::2] == (0, "")
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert lost[0] == 1
    assert "no file is written: lost returned no point" in lost[2]
    assert not (tmp_path / "b.png").exists()


def test_the_answer_is_written_unless_there_is_no_point(cli, tmp_path):
    written = cli("solve", "well/primal", "--solver", "exact", "--out", "a.npz")
    lost = cli("solve", "well/primal", "--solver", "lost", "--out", "b.npz")
    wrong = cli("solve", "well/primal", "--solver", "exact", "--out", "a.csv")

    assert written[::2] == (0, "")
    with np.load(tmp_path / "a.npz") as stored:
        assert {"x", "y", "z", "z_box"} <= set(stored)
    assert "no file is written: lost returned no point" in lost[2]
    assert not (tmp_path / "b.npz").exists()
    assert wrong[0] == 2
    assert "a.csv: unknown format '.csv'; expected .npz" in wrong[2]


def test_an_exported_qp_is_the_emitted_qp_with_the_name_of_its_case(cli, tmp_path):
    file = tmp_path / "well.npz"
    code, out, _ = cli("export", "well/depth=4/n=2/dual", file)

    qp, meta = load_qp(file)
    assert (code, out) == (0, f"{file}\n")
    assert qp.q.tolist() == [-4, -4]
    assert meta["name"] == "well/n=2/depth=4/dual"
    assert (meta["scale"], meta["constant"]) == (2.0, 0.0)


def test_doctor_prints_the_same_as_json(cli):
    code, out, _ = cli("doctor", "--json")
    told = json.loads(out)

    assert code == 0
    assert told["environment"]["versions"]["numpy"]
    assert told["fit"] == (not told["advice"])


def test_an_interrupt_exits_with_130_and_one_line(cli):
    code, out, err = cli("solve", "well/depth=13/primal", "--solver", "exact")

    assert (code, out, err) == (130, "", "mortarbench: interrupted\n")


def test_an_interrupted_run_prints_how_to_continue(cli, monkeypatch):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(Journal, "append", interrupt)
    code, out, err = cli("run", "tiny")

    assert (code, out) == (130, "")
    assert err.endswith("mortarbench: interrupted; the same command continues\n")


def test_output_of_a_solver_is_not_mixed_with_results(cli):
    code, out, _ = cli("solve", "well/primal", "--solver", "prints", "--json")

    assert (code, json.loads(out)["status"]) == (0, "verified")
    assert out.count("\n") == 1


def test_a_crashed_solver_yields_a_record(cli):
    code, out, _ = cli("solve", "well/primal", "--solver", "dies", "--json")

    record = json.loads(out)
    assert (code, record["status"]) == (1, "crashed")
    assert record["message"] == "exit code 7: my last words"
    assert record["sizes"]["variables"] == 3


@pytest.mark.slow
def test_every_command_prints_only_json_even_if_a_library_in_c_prints(pit, tmp_path):
    """A library may print on the file descriptor 1 of the process of the command."""
    noise = "\nimport os\nos.write(1, b'from C\\n')\n"
    with (tmp_path / "plug.py").open("a") as file:
        file.write(noise)
    plugin = ("--plugin", "plug.py")
    commands = {
        "list": ("list", "solvers", *plugin),
        "run": pit,
        "solve": ("solve", "pit/primal", "--solver", "times", *plugin),
        "test-solver": ("test-solver", "times", *plugin),
        "validate": ("validate", "out/pit", *plugin),
        "report": ("report", "out/pit", "--format", "csv"),
        "replay": ("replay", "out/pit", "RUN_ID", *plugin),
        "doctor": ("doctor",),
        "dataset info": ("dataset", "info"),
    }
    for arguments in commands.values():
        if "RUN_ID" in arguments:
            (journal,) = (tmp_path / "out/pit/journal").iterdir()
            run_id = json.loads(journal.read_text().splitlines()[0])["run_id"]
            arguments = [run_id if a == "RUN_ID" else a for a in arguments]
        done = subprocess.run(
            [sys.executable, "-m", "mortarbench", *arguments, "--json"],
            capture_output=True, text=True, check=False, cwd=tmp_path,
        )  # fmt: skip

        assert json.loads(done.stdout), (arguments, done.stderr)
        assert ("from C" in done.stderr) == ("plug.py" in arguments)
    assert set(commands) == {
        name
        for name in COMMANDS
        if any(a.dest == "json" for a in command_parser(name.split()).arguments())
    }


@pytest.mark.parametrize("closed", [">&-", "2>&-", ">&- 2>&-", "<&-"])
def test_closed_streams_do_not_matter(closed):
    command = f"{sys.executable} -m mortarbench list solvers {closed}"
    done = subprocess.run(command, shell=True, capture_output=True, check=False)

    assert (done.returncode, done.stderr) == (0, b"")


def test_a_closed_output_pipe_is_not_an_error():
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run(
        [sys.executable, "-m", "mortarbench", "list", "solvers"],
        stdout=writing, stderr=subprocess.PIPE, text=True, check=False,
    )  # fmt: skip
    os.close(writing)

    assert (done.returncode, done.stderr) == (0, "")


def test_an_ascii_terminal_is_sufficient(tmp_path):
    (tmp_path / "plug.py").write_text(
        PLUGIN.replace("Pit(Family):\n", 'Pit(Family):\n    """λ ≥ 0."""\n'), "utf-8"
    )
    done = subprocess.run(
        [sys.executable, "-m", "mortarbench", "list", "problems", "--plugin",
         "plug.py"],
        env=os.environ | {"PYTHONIOENCODING": "ascii"},
        cwd=tmp_path, capture_output=True, text=True, check=False,
    )  # fmt: skip

    assert done.returncode == 0
    assert "? ? 0." in done.stdout


def test_a_file_that_cannot_be_written_is_named(
    registries, capsys, monkeypatch, tmp_path
):
    def report(folder, formats, factor):
        raise PermissionError(13, "Permission denied", str(folder / "index.html"))

    monkeypatch.setattr(WRITE_REPORT, report)
    assert main(registries, ["report", str(tmp_path)]) == 2
    assert capsys.readouterr().err == (
        f"mortarbench: {tmp_path}/index.html: Permission denied\n"
    )


def test_an_internal_error_exits_with_3_and_a_traceback(cli):
    code, out, err = cli("solve", "well/depth=99/primal", "--solver", "exact")

    assert (code, out) == (3, "")
    assert "Traceback" in err
    assert "ZeroDivisionError: a fault of ours" in err


SOLVE = ("solve", "well/primal", "--solver", "exact")
WRONG = {
    "no command": ((), "the following arguments are required: COMMAND; usage: morta"),
    "unknown command": (("rnu",), "unknown command 'rnu'; did you mean 'run'? known: "),
    "unknown option": (
        ("run", "tiny", "--repeat", "3"),
        "unknown argument '--repeat'; did you mean --repeats? usage: mortarbench run ",
    ),
    "no solver": (("solve", "well/primal"), "arguments are required: --solver"),
    "unknown family": (
        ("solve", "wel/primal", "--solver", "exact"),
        "unknown family 'wel'; did you mean 'well'? known: well",
    ),
    "scale": (
        (*SOLVE, "--plot", "a.pdf", "--scale", "nan"),
        "--scale = nan; expected a number of magnitude at most 1e+09",
    ),
    "picture nowhere": (
        (*SOLVE, "--plot", "no/a.png"),
        "no/a.png: the folder no does not exist; expec",
    ),
    "out of range": (
        ("solve", "well/depth=97/primal", "--solver", "exact"),
        "well: depth=97 is out of range",
    ),
    "out of memory": (
        ("export", "well/depth=98/primal", "a.npz"),
        "well/depth=98/primal could not be built: "
        "it needs more memory than is available",
    ),
    "plug-in that cannot build": (
        ("export", "deeper/depth=99/primal", "a.npz", "--plugin", "deeper.py"),
        "deeper.py: deeper/depth=99/primal could not be built: ZeroDivisionError: a fa",
    ),
    "nowhere to write": (("run", "tiny", "--out", ""), "--out is empty; expected a"),
    "nothing to draw": (
        ("solve", "well/dual", "--solver", "exact", "--plot", "a.png"),
        "well/dual has no bodies to draw; leave out --plot",
    ),
    "report format": (
        ("report", "folder", "--format", "md,htm"),
        "--format: unknown format 'htm'; did you mean 'html'? known: csv, html",
    ),
    "missing plug-in": (
        (*SOLVE, "--plugin", "gone.py"),
        "gone.py: no such file; expect",
    ),
    "unknown suite": (
        ("run", "tinny"),
        "unknown suite 'tinny'; did you mean 'tiny'? known: tiny",
    ),
    "pattern of run": (
        ("run", "tiny", "--case", "*/duel"),
        "the 2 cases of the suite; its cases are well/primal, well/dual",
    ),
}


@pytest.mark.parametrize(("argv", "message"), WRONG.values(), ids=WRONG.keys())
def test_wrong_input_is_one_line_with_the_remedy_and_exits_with_2(
    cli, tmp_path, argv, message
):
    (tmp_path / "deeper.py").write_text(DEEPER.format(str(TOY_PROBLEM)))
    code, out, err = cli(*argv)

    assert (code, out) == (2, "")
    assert err.startswith("mortarbench: ")
    assert err.endswith("\n")
    assert err.count("\n") == 1
    assert message in err
    assert not (tmp_path / "out").exists()


DEEPER = """
from pathlib import Path
from mortarbench.harness.registry import load_plugin

PROBLEMS = {{"deeper": load_plugin(Path({!r})).problems["well"]}}
"""


def test_the_version_is_that_of_the_package(cli, capsys):
    with pytest.raises(SystemExit) as e:
        cli("--version")

    assert e.value.code == 0
    assert capsys.readouterr().out == f"mortarbench {version('mortarbench')}\n"


def test_every_command_and_option_has_a_help_text():
    for name in COMMANDS:
        parser = command = command_parser(name.split())
        for word in name.split():
            (commands,) = command._subparsers._group_actions
            command = commands.choices[word]
        assert command.description
        assert all(action.help for action in parser.arguments()), name


PLUGIN = """
from dataclasses import dataclass
import numpy as np
from mortarbench import QP, Case, Family, Solution, Status

print("a plug-in says hello")

@dataclass(frozen=True)
class Pit(Family):
    forms = ("primal",)
    n: int = 3
    def build(self, form, reference):
        n = self.n
        print("a family says hello")
        if n == 99:
            raise ZeroDivisionError("no\\nbottom")
        qp = QP.from_arrays(np.eye(n), -np.ones(n), lb=np.zeros(n))
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
    assert err.splitlines()[-1].startswith("12/12 ")
    statuses = {(r.solver, r.status) for r in read_journal(Path("out/pit"))}
    assert statuses == {
        ("times", "verified"), ("twice", "wrong"), ("near", "inaccurate")
    }  # fmt: skip


def test_a_restricted_run_is_part_of_the_whole_run(cli, pit):
    narrow = ("--solver", "twice", "--case", "pit/n=2/*", "--repeats", "1")
    cli(*pit, "--out", "here", *narrow)
    first = read_journal(Path("here"))
    cli(*pit, "--out", "here")
    both = read_journal(Path("here"))

    assert [(r.solver, r.case) for r in first] == [("twice", "pit/n=2/primal")]
    assert len(both) == 12
    assert both[0] == first[0]


@pytest.mark.parametrize(("load", "lines"), [(0.4, 0), (0.6, 1)])
def test_a_run_on_a_busy_machine_prints_a_warning(cli, pit, monkeypatch, load, lines):
    monkeypatch.setattr(os, "getloadavg", lambda: (load, 0.0, 0.0))

    err = cli(*pit, "--solver", "times", "--repeats", "1")[2]

    assert err.count("mortarbench: other programs keep 0.6 cores busy") == lines


def test_a_run_continues_if_its_output_is_closed():
    reading, writing = os.pipe()
    os.close(reading)
    with open(writing, "w", buffering=1) as stream, display_on(stream) as progress:
        progress.start(7)
        progress.warn("who is there?")
        os.dup2(
            os.open(os.devnull, os.O_WRONLY), writing
        )  # so that closing it succeeds


def test_a_complete_quiet_run_prints_nothing(cli):
    assert cli("run", "tiny", "--quiet") == (0, "", "")
    code, out, err = cli("run", "tiny", "--quiet", "--json")
    assert (code, err) == (0, "")
    assert json.loads(out)["solvers"]["exact"] == {"verified": 6}


def test_the_dual_that_a_decline_names_is_solved(capsys):
    case = "beam-ring/Nr=2/Nh=2/steps=1"
    main(Registries(), ["solve", f"{case}/primal", "--solver", "smalbe"])
    named = capsys.readouterr().err.rpartition("solve ")[2].strip()

    assert main(Registries(), ["solve", named, "--solver", "smalbe"]) == 0
