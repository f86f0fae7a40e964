"""Commands and sessions in the documents work, in the order of their page.

The commands of a page are in blocks ```sh; those of the README are indented lines.
Python sessions are in blocks ```pycon, and print the output shown. The files that they
need are the blocks after ``<!-- file: NAME -->``. Commands that take too long are run
in a shorter form, and those that cannot be run here are listed with the reason.
"""

import doctest
import json
import re
import shlex
import shutil
import subprocess
import sys

import pytest

from mortarbench import __main__ as root
from tests.support import ROOT

PAGES = [
    ROOT / "README.md",
    ROOT / "CONTRIBUTING.md",
    *sorted((ROOT / "docs").glob("*.md")),
]

_SMALL = "--case '*Nr=4/Nh=3/step=1/*'"

#: shorter commands that are run instead
SHORTER = {
    "mortarbench run demo": f"mortarbench run demo {_SMALL} --repeats 2",
    "mortarbench run demo --out out/demo-again": (
        f"mortarbench run demo {_SMALL} --repeats 2 --out out/demo-again"
    ),
    "mortarbench run scaling": (
        "mortarbench run scaling --case '*Nr=[468]/*/dual' --repeats 1 --solver smalbe"
    ),
    "mortarbench run crossval": (
        "mortarbench run crossval --case 'contact-patch/*' --solver smalbe "
        "--solver clarabel"
    ),
    "mortarbench run suites/crossval.toml --out out/crossval": (
        "mortarbench run suites/crossval.toml --out out/crossval "
        "--case 'contact-patch/*' --solver smalbe --solver clarabel"
    ),
    "mortarbench run suites/crossover.toml --out out/crossover": (
        "mortarbench run suites/crossover.toml --out out/crossover --repeats 1 "
        "--case 'cube-wall/n=6/dual' --solver smalbe"
    ),
    "mortarbench run suites/accuracy.toml": (
        "mortarbench run suites/accuracy.toml --repeats 1 --case 'obstacle/*'"
    ),
    "mortarbench validate out/make-demo": "mortarbench validate out/demo",
    "mortarbench run mine.toml": "mortarbench run mine.toml --repeats 2",
    "mortarbench run profiles.toml": "mortarbench run profiles.toml --repeats 1",
    "mortarbench run mine.toml --out out/again": (
        "mortarbench run mine.toml --repeats 2 --out out/again"
    ),
    "mortarbench run suites/demo.toml --solver smalbe --solver osqp "
    "--case '*Nr=4*/dual' --repeats 10 --out out/part": (
        "mortarbench run suites/demo.toml --solver smalbe --solver osqp "
        "--case '*Nr=4*step=1/dual' --repeats 2 --out out/part"
    ),
    "mortarbench run suites/demo.toml --solver smalbe --case '*/dual' --repeats 10": (
        "mortarbench run suites/demo.toml --solver smalbe --case '*Nr=4*step=1/dual' "
        "--repeats 2"
    ),
    "mortarbench run suites/scaling.toml": (
        "mortarbench run suites/scaling.toml --case '*Nr=[468]/*/dual' --repeats 1 "
        "--solver smalbe"
    ),
    "mortarbench run suites/scaling-feti.toml": (
        "mortarbench run suites/scaling-feti.toml --case 'membranes/S=[24]/*' "
        "--repeats 1"
    ),
    "mortarbench run finite-strain": (
        "mortarbench run finite-strain --solver smalbe --repeats 1 "
        "--case '*/step=1/*/dual'"
    ),
    "mortarbench run suites/fleet.toml": (
        "mortarbench run suites/fleet.toml --case '*Nr=4/Nh=3/dual' --solver pdas"
    ),
    "mortarbench solve beam-ring/Nr=30/Nh=15/dual --solver smalbe --tol 1e-9 "
    "--plot beam.png --vtu beam.vtu": (
        "mortarbench solve beam-ring/Nr=4/Nh=3/dual --solver smalbe --tol 1e-9 "
        "--plot beam.png --vtu beam.vtu"
    ),
    "mortarbench export beam-ring/Nr=12/Nh=6/step=5/dual qp.npz": (
        "mortarbench export beam-ring/Nr=4/Nh=3/step=5/dual qp.npz"
    ),
    "mortarbench report out/make-demo --format md,tex": (
        "mortarbench report out/demo --format md,tex"
    ),
    "mortarbench report out/make-demo --factor 1": (
        "mortarbench report out/demo --format md --factor 1"
    ),
    "mortarbench report out/make-demo --verbose": (
        "mortarbench report out/demo --format md --verbose"
    ),
    "mortarbench report out/make-demo out/demo": (
        "mortarbench report out/demo out/demo"
    ),
}

#: commands that are not run, with the reason
ELSEWHERE = {
    "make setup": "the environment exists",
    "make demo": "the environment exists; `mortarbench run demo` is tested",
    "make test": "it would run itself",
    ". .venv/bin/activate": "the environment is active",
    "mortarbench paper --quick": "test_paper.py, with fewer samples",
    "mortarbench replay out/make-demo RUN_ID": "test_replay.py; it needs a run_id",
    "mortarbench run suites/demo.toml --dask tcp://HOST:8786": "test_cluster.py",
    "mortarbench run fleet --dask tcp://login1:8786": "test_cluster.py",
    "mortarbench run demo --dask local": "test_cluster.py",
    "mortarbench run ranks": "test_ranks.py, a smaller suite of ranks",
    "mortarbench run fleet --dask tls://login1:8786": "test_cluster_tls.py",
    "python cluster.py": "it submits jobs to a batch system",
    "python benchmarks/ranks.py": "a measurement of minutes, in a checkout",
    "mortarbench run fleet --out out/fleet --dask tcp://login1:PORT": "the same",
    "gmsh -2 -order 1 press.geo": "gmsh is not installed; its output is in tests/data",
    ".venv/bin/python -m pip install -c constraints.txt -e '.[cluster]'": (
        "the environment exists"
    ),
}
#: files that programs outside of the test environment would write, by page
SUPPLIED = {
    "own-bodies": ("press.msh", "blocks.msh", "blocks.toml"),
}
#: files that the commands of a page must write, with a pattern of their contents
PROMISED = {
    "tutorial": {
        "beam.png": "",
        "out/mine/report/report.md": r"osqp-polish",
        "out/mine/report/records.parquet": "",
        "out/again/report/against-mine/index.html": r"changes from mine to again",
    },
    "own-bodies": {
        "press.png": "",
        "press.vtu": r'Name="pressure"',
        "press-disc-on-upper.csv": "pressure_Pa",
        "blocks-upper-on-lower.csv": "pressure_Pa",
    },
    "howto": {
        "out/scaling/report/tables/scaling.tex": r"\d\.\d\d \[-?\d+\.\d+, \d+\.\d+\]",
        "out/scaling/report/figures/scaling-1.pdf": "",
        "out/profiles/report/figures/profiles-1.pdf": "",
        "out/profiles/report/figures/pairwise-1.pdf": "",
        "out/profiles/report/tables/contests.csv": r"all forms",
        "out/profiles/report/report.md": r"Pooled forms: dual 6 cases, primal 6",
        "out/crossval/validation.json": "",
        "out/crossval/report/validation.html": r"No disagreement",
        "out/demo/report/report.md": r"1 × tolerance",
        "out/demo-again/report/against-demo/report.md": r"Verdicts: 0 worse",
        "out/own/report/report.md": r"gradients: verified on all 2 cases",
    },
}
_BEGIN = ("mortarbench ", "make ", "python ", ". .venv", ".venv/bin/")
_LAST = re.compile(r"\s+#\s+exit code (\d)$")


def parts(text):
    """Yield the instructions of a page: ("file", name, content), ("run", command,
    code) or ("session", text, 0).
    """
    fence, name, lines = None, None, []
    for line in text.splitlines():
        if fence is None and (found := re.fullmatch(r"<!-- file: (\S+) -->", line)):
            name = found[1]
        elif line.startswith("```") and fence is None:
            fence, lines = line[3:], []
        elif line.startswith("```"):
            if name is not None:
                yield "file", name, "\n".join(lines) + "\n"
            elif fence == "pycon":
                yield "session", "\n".join(lines) + "\n", 0
            elif fence == "sh":
                yield from (("run", *command(each)) for each in lines if each)
            fence = name = None
        elif fence is not None:
            lines.append(line)
        elif line.startswith("    ") and line.strip().startswith(_BEGIN):
            yield "run", *command(line)


def command(line):
    """Split a line into a command and its expected exit code."""
    found = _LAST.search(line)
    bare = " ".join(shlex.quote(w) for w in shlex.split(line, comments=True))
    return bare, int(found[1]) if found else 0


def normal(commands):
    return {command(text)[0]: value for text, value in commands.items()}


def shown(page):
    return list(parts(page.read_text("utf-8")))


def test_every_omitted_command_is_shown_on_a_page():
    commands = {what for p in PAGES for kind, what, _ in shown(p) if kind == "run"}

    assert set(normal(SHORTER)) | set(normal(ELSEWHERE)) <= commands
    assert not set(normal(SHORTER)) & set(normal(ELSEWHERE))


def test_mortarbench_commands_are_only_in_blocks_that_are_run():
    """No line of a block that the tests skip begins with `mortarbench`."""
    for page in PAGES:
        blocks = re.findall(
            r"^```(\w*)\n(.*?)^```", page.read_text("utf-8"), re.M | re.S
        )
        for kind, text in blocks:
            assert kind == "sh" or not re.search(r"^mortarbench ", text, re.M), page


@pytest.fixture
def execute(tmp_path, monkeypatch, capsys):
    """Run one command in a folder that contains the suites, as a user would."""
    (tmp_path / "suites").symlink_to(ROOT / "suites")
    monkeypatch.chdir(tmp_path)

    def run(text):
        first, *arguments = shlex.split(text)
        if first == "python":
            return subprocess.run([sys.executable, *arguments], check=False).returncode
        assert first == "mortarbench", f"{text}: neither run nor named in ELSEWHERE"
        monkeypatch.setattr(sys, "argv", [first, *arguments])
        with pytest.raises(SystemExit) as ended:
            root.main()
        output = capsys.readouterr()
        assert "Traceback" not in output.err, output.err
        if "--json" in arguments:
            json.loads(output.out)
        return ended.value.code

    return run


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_command_and_session_of_a_page_works(page, execute, tmp_path, capsys):
    """They run in the order of the page and may read files that earlier ones wrote."""
    instead, elsewhere = normal(SHORTER), normal(ELSEWHERE)
    parser, runner = (
        doctest.DocTestParser(),
        doctest.DocTestRunner(optionflags=doctest.ELLIPSIS),
    )
    names = {}
    for name in SUPPLIED.get(page.stem, ()):
        shutil.copy(ROOT / "tests" / "data" / name, tmp_path)
    for kind, what, more in shown(page):
        if kind == "file":
            (tmp_path / what).write_text(more, "utf-8")
        elif kind == "session":
            session = parser.get_doctest(what, names, page.stem, None, 0)
            failed = runner.run(session, clear_globs=False).failed
            assert failed == 0, capsys.readouterr().out
            names = session.globs
        elif what not in elsewhere:
            assert execute(instead.get(what, what)) == more, what
    for file, pattern in PROMISED.get(page.stem, {}).items():
        written = (tmp_path / file).read_bytes().decode("utf-8", "replace")
        assert re.search(pattern, written), file
