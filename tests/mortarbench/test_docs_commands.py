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

#: shorter commands that are run instead
SHORTER = {
    "mortarbench run demo": (
        "mortarbench run demo --case '*Nr=4/Nh=3/step=1/*' --repeats 2"
    ),
    "mortarbench run mine.toml": "mortarbench run mine.toml --repeats 2",
    "mortarbench run mine.toml --out out/again": (
        "mortarbench run mine.toml --repeats 2 --out out/again"
    ),
    # two folders of equal times decide the gate
    "mortarbench report out/sizes out/more --fail-on worse,slower=1.2": (
        "mortarbench report out/sizes out/sizes --fail-on worse,slower=1.2"
    ),
    "mortarbench report out/versions --compare old:mine,new:mine "
    "--fail-on worse,slower=1.2": (
        "mortarbench report out/versions --compare old:mine,new:mine"
    ),
    "mortarbench run suites/crossover.toml --out out/crossover": (
        "mortarbench run suites/crossover.toml --out out/crossover --repeats 1 "
        "--case 'cube-wall/n=6/dual' --solver smalbe"
    ),
    "mortarbench run suites/scaling-feti.toml": (
        "mortarbench run suites/scaling-feti.toml --case 'membranes/S=[24]/*' "
        "--repeats 1"
    ),
    "mortarbench run finite-strain": (
        "mortarbench run finite-strain --solver smalbe --repeats 1 "
        "--case '*/step=1/*/dual'"
    ),
    "mortarbench solve beam-ring/Nr=30/Nh=15/dual --solver smalbe-paper "
    "--plot figure7.png": (
        "mortarbench solve beam-ring/Nr=4/Nh=3/dual --solver smalbe-paper "
        "--plot figure7.png"
    ),
}

#: commands that are not run, with the reason
ELSEWHERE = {
    "make setup": "the environment exists",
    "make demo": "the environment exists; `mortarbench run demo` is tested",
    "make test": "it would run itself",
    ". .venv/bin/activate": "the environment is active",
    ".venv/bin/lint-imports": "part of `make test`",
    "mortarbench paper --quick": "test_paper.py, with fewer samples",
    "mortarbench replay out/demo RUN_ID": "it needs a run_id; docs/python.md",
    "mortarbench replay out/sizes SESSION-RUN_ID": "the same",
    "mortarbench dataset leaderboard contact-set": "test_folder.py, on seven items",
    "mortarbench dataset leaderboard contact-set --plugin mine.py --solver mine "
    "--solver smalbe --solver piqp --out out/mine": "the same",
    "mortarbench run ranks": "test_ranks.py, a smaller suite of ranks",
    "mortarbench run fleet --dask tcp://login1:8786": "test_cluster.py",
    "mortarbench run fleet --dask tls://login1:8786": "test_cluster.py",
    "gmsh -2 -order 1 press.geo": "gmsh is not installed; its output is in tests/data",
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
        "out/again/report/against-mine/index.html": r"mine to mine",
    },
    "own-bodies": {
        "press.png": "",
        "press.vtu": r'Name="pressure"',
        "press-disc-on-upper.csv": "pressure_Pa",
        "blocks-upper-on-lower.csv": "pressure_Pa",
    },
    "compare": {
        "out/smoke/report/tables/answer.tex": r"\\label\{tab:answer\}",
        "out/sizes/report/report.md": r"residuals ≤ 1 × tol",
        "out/sizes/report/compared/index.html": r"osqp to clarabel",
        "out/more/report/against-sizes/report.md": r"before: osqp",
        "out/sizes/report/validation.html": r"No disagreement",
    },
    "own-solver": {"out/versions/report/compared/report.md": r"before: old:mine"},
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
