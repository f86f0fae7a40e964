"""Examples and commands in the documents."""

import re
import shlex
import sys
from importlib.metadata import version

import pytest
import yaml

from mortarbench.answer import solve
from mortarbench.cli.main import command_parser, main
from mortarbench.harness import (
    Residuals,
    Status,
    verdict,
)
from mortarbench.harness.limits import ONE_THREAD
from mortarbench.harness.record import VERIFIED_FACTOR
from mortarbench.harness.registry import load_plugin
from mortarbench.harness.verify import measure
from mortarbench.harness.verify.kkt import kkt_residuals
from mortarbench.listing import about
from mortarbench.problems.families.beam_ring import BeamRing
from mortarbench.registries import Registries
from mortarbench.reports.answer import COMPLETE
from mortarbench.solvers import SOLVERS
from mortarbench.solvers.reference.solve import reference_solution
from tests.support import ROOT

sys.path.append(str(ROOT / "tools" / "site"))
import pages as site  # the hook of mkdocs

DOCUMENTS = [
    *sorted((ROOT / "docs").glob("*.md")),
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
]


def code_of(page, name):
    """Return the file `name` that a page shows."""
    text = (ROOT / "docs" / page).read_text("utf-8")
    (code,) = re.findall(rf"<!-- file: {name} -->\n```python\n(.*?)```", text, re.S)
    return code


def test_the_solver_of_the_page_for_authors_solves(tmp_path):
    """The solver has fewer than 30 lines and solves a dual with bounds only."""
    code = code_of("own-solver.md", "lbfgsb.py")
    path = tmp_path / "lbfgsb.py"
    path.write_text(code)
    solver = load_plugin(path).solvers["lbfgsb"]
    family = BeamRing()
    configured = family.with_keys(Nr=4, Nh=3, steps=1)
    qp = configured.build("dual-bounds", reference_solution).qp
    s = solver.prepare(qp, 1e-8)()

    assert len(code.splitlines()) < 30
    assert solver.declines(configured.build("primal", reference_solution).qp)
    assert kkt_residuals(qp, s).primal == 0
    assert qp.objective(s.x) - qp.objective(reference_solution(qp).x) <= 1e-7 * abs(
        qp.objective(s.x)
    )


def test_the_steps_that_their_page_shows_solve(tmp_path):
    """The steps converge with the default damping factor and with the factors 0, 0.7
    and 1.
    """
    path = tmp_path / "damped.py"
    path.write_text(code_of("own-solver.md", "damped.py"))
    for options in ({}, {"damping": 0.0}, {"damping": 0.7}, {"damping": 1.0}):
        answer = solve("string/n=60/primal", "damped", plugins=[path], options=options)
        assert str(answer.verdict) == "verified"
        assert answer.solution.counts["preconditioner_applies"] > 0
        assert answer.solution.counts["expansion"] > 0


def test_the_page_of_solvers_states_the_facts_of_each():
    page = site.GENERATED["solvers.md"]()
    for name, solver in SOLVERS.items():
        assert f"| `{name}` |" in page
        facts = about(solver)
        for fact in (facts.licence, facts.phases, *facts.limits) if facts else ():
            assert fact in page
    assert "| `max_iter` | 250 | 250 | 250 |  |" in page
    assert (
        "| `backend` | 'auto' | 'dense' | 'sparse' | auto: dense if P is dense |"
        in page
    )


def test_every_family_and_suite_that_commands_name_exists():
    from mortarbench.problems import PROBLEMS

    text = "".join(page.read_text("utf-8") for page in DOCUMENTS)

    names = set(re.findall(r"mortarbench solve ([\w-]+)[/:]", text))
    own = set(re.findall(r"mortarbench new problem ([\w-]+)", text))
    assert {"beam-ring", "contact-patch", "bodies"} <= names <= own | set(PROBLEMS)
    for suite in re.findall(r"suites/[\w-]+\.toml", text):
        assert (ROOT / suite).is_file()


def test_the_documents_are_a_book_of_two_hours():
    """At most 22 pages in docs/, 40 000 words in all, and a start page of 500."""
    words = {p.name: len(p.read_text("utf-8").split()) for p in DOCUMENTS}

    assert len(list((ROOT / "docs").glob("*.md"))) <= 22
    assert sum(words.values()) <= 40_000
    assert words["README.md"] <= 500


def test_a_page_opens_with_its_question_and_a_command():
    """The question is in bold; a block of commands or a session follows early."""
    for page in DOCUMENTS:
        text = page.read_text("utf-8")
        if page.name in ("CHANGELOG.md", "glossary.md"):
            continue
        assert re.match(r"# .+\n\n\*\*[^*]+\?\*\*", text), page


@pytest.mark.parametrize("page", DOCUMENTS, ids=lambda page: page.stem)
def test_a_page_has_at_most_2500_words(page):
    assert len(page.read_text("utf-8").split()) <= 2500


def test_the_start_page_links_every_kind_of_user_to_a_page_with_commands():
    """Every page that the table names to read first contains a block of commands or a
    session that the tests execute.
    """
    start = (ROOT / "README.md").read_text("utf-8")
    table = start.partition("## Where to start")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| .*\*\*.*$", table, re.M)

    assert len(rows) == 4
    for row in rows:
        first = re.findall(r"\]\((docs/[\w-]+\.md)", row.split("|")[2])
        assert first
        for page in first:
            assert re.search(r"^(```sh|```pycon)$", (ROOT / page).read_text(), re.M)


def test_every_file_that_a_page_names_exists():
    """Paths in backquotes are relative to the root, and links to the folder of the
    page.
    """
    pages = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *ROOT.glob("docs/*.md")]
    rooms = "harness|problems|solvers|reports|mortarbench|tests|suites|benchmarks|docs"
    for page in pages:
        text = page.read_text("utf-8")
        named = re.findall(rf"`((?:{rooms})/[\w./-]+\.\w+)`", text)
        lost = [n for n in named if not (ROOT / n).exists() and "NAME" not in n]
        assert lost == [], page
        links = re.findall(r"\]\((?!\w+:)([^)#]+)", text)
        links = [n for n in links if n not in site.GENERATED]
        assert [n for n in links if not (page.parent / n).exists()] == [], page


def test_every_page_has_a_place_on_the_site():
    """`make site` also fails if a page is missing from the navigation; this test does
    not build the site.
    """
    nav = (ROOT / "mkdocs.yml").read_text("utf-8").partition("\nnav:")[2]
    folder = ROOT / "docs"
    found = {p.name for p in folder.glob("*.md")}
    found |= {f"gallery/{p.stem}.md" for p in folder.glob("gallery/*.ipynb")}
    made = {"index.md", "contributing.md", "changelog.md", *site.GENERATED}

    assert set(re.findall(r": (\S+\.md)$", nav, re.M)) == found | made


def workflow():
    """Yield the commands of the CI workflow, with the variables of its
    header filled in.
    """
    whole = yaml.safe_load((ROOT / "docs/ci/mortarbench.yml").read_text("utf-8"))
    steps = [step for job in whole["jobs"].values() for step in job["steps"]]
    for text in (step["run"] for step in steps if "run" in step):
        for name, value in whole["env"].items():
            text = text.replace(f"${name}", value)
        yield from (shlex.split(line) for line in text.splitlines())


def test_the_workflow_for_ci_calls_existing_commands():
    commands = [words[1:] for words in workflow() if words[0] == "mortarbench"]

    assert [words[0] for words in commands] == ["test-solver", "run", "report"]
    for words in commands:
        assert command_parser(words).parse_known_args(words)[1] == []


@pytest.mark.slow
def test_the_workflow_for_ci_passes_with_a_new_solver(tmp_path, monkeypatch, capsys):
    """The repository is created by `new solver mine` and `new suite compare`."""
    monkeypatch.chdir(tmp_path)
    for kind, name in (("solver", "mine"), ("suite", "compare")):
        assert main(Registries(), ["new", kind, name]) == 0
    (tmp_path / "base").mkdir()
    (tmp_path / "base" / "mine.py").write_text((tmp_path / "mine.py").read_text())

    for first, *words in workflow():
        if first == "mortarbench":
            # both versions are equal: whether this can be told depends on the noise
            allowed = {0, 1, 2} if words[0] == "report" else {0}
            assert main(Registries(), words) in allowed, (words, capsys.readouterr())
    assert (tmp_path / "out/ci/report/compared/index.html").is_file()


def test_the_citation_is_of_this_version_and_names_the_paper():
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text("utf-8"))
    (paper,) = citation["references"]

    assert citation["cff-version"] == "1.2.0"
    assert citation["version"] == version("mortarbench")
    assert citation["license"] == "BSD-3-Clause"
    assert paper["doi"] == "10.4203/ccc.9.10.5"
    assert [a["family-names"] for a in paper["authors"]] == [
        "Pospíšil", "Světlík", "Varga", "Čermák",
    ]  # fmt: skip


def test_the_comparison_policy_agrees_with_the_code():
    """The sentences are numbered without gaps and state the constants of the code."""
    page = (ROOT / "docs/policy.md").read_text("utf-8")
    sentences = dict(
        re.findall(r"^- <span id=\"s(\d+)\">\*\*\1\.\*\*</span> (.*)", page, re.M)
    )
    libraries = ("OMP", "OPENBLAS", "MKL", "BLIS", "NUMEXPR", "RAYON")

    assert list(sentences) == [str(n) for n in range(1, 42)]
    assert {f"{name}_NUM_THREADS": "1" for name in libraries} == ONE_THREAD
    assert "OpenMP, OpenBLAS, MKL, BLIS, NumExpr and Rayon" in sentences["25"]
    assert f"up to {measure.MAX_ASSEMBLED_ROWS} rows" in sentences["13"]
    assert f"together take {1e3 * measure.SAMPLE_SECONDS:g} ms" in sentences["22"]
    assert f"at most {measure.MAX_INNER_LOOPS} times" in sentences["22"]
    assert f"more than {measure.MAX_UNTIMED_SECONDS:g} s" in sentences["22"]
    assert measure.REMEMBERED_SPEEDUP == 5
    assert "more than five times as long" in sentences["21"]
    assert "at most ten times the tolerance" in sentences["32"]
    assert VERIFIED_FACTOR == 10
    assert verdict(Status.ITERATION_LIMIT, Residuals(0, 0, 0, 0), 1e-6).is_verified
    assert f"at least {100 * COMPLETE:g} % of the cases" in sentences["37"]
