"""Growth and merging of campaigns, and CI gates, tested by runs of toy problems."""

import json
import os
import shutil
import signal

import pytest

import mortarbench as mb
from mortarbench.harness.files.store import is_stored
from mortarbench.harness.results.folder import environment_of
from mortarbench.harness.results.journal import read_journal
from mortarbench.registries import Registries
from mortarbench.reports.answer import rows
from mortarbench.reports.document import markdown
from mortarbench.reports.measurements import read_measurements
from mortarbench.reports.sections import compose
from tests.support import TOY_PROBLEM

pytestmark = pytest.mark.together


def suite(solvers='"exact", "lax"', depths="1, 2", **settings):
    lines = [f"{key} = {value}" for key, value in settings.items()]
    head = f'name = "c"\nsolvers = [{solvers}]\n' + "\n".join(lines)
    return (
        f'{head}\n[[problems]]\nfamily = "well"\nforms = ["dual"]\n'
        f"params = {{ depth = [{depths}] }}\n"
    )


@pytest.fixture(scope="module", autouse=True)
def _found():
    """Replace the description of this machine with a constant."""
    here = {"machine": {"cpu": "one"}}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Registries, "environment", lambda _: here)
        yield here


@pytest.fixture
def environment(_found):
    """Return a constant description of this machine, which a test may change."""
    before = dict(_found["machine"])
    yield _found
    _found["machine"] = before


@pytest.fixture
def measure(tmp_path):
    """Return a function that runs a suite created by `suite` in the folder `out`."""

    def measure(out="out", **asked):
        file = tmp_path / f"{out}.toml"
        file.write_text(suite(**({"repeats": 2} | asked)))
        return mb.run(file, out=tmp_path / out, plugins=[TOY_PROBLEM])

    return measure


def plant_times(folder, **seconds):
    """Replace the measured times in a result folder by `seconds` of each label, so that
    what the report concludes from them does not depend on this machine.
    """
    (file,) = (folder / "journal").glob("*.jsonl")
    records = [json.loads(line) for line in file.read_text().splitlines()]
    for one in records:
        planted = seconds[one["solver"]] * (1 + 0.01 * one["repeat"])
        one |= {"prepare_seconds": 0.0, "solve_seconds": planted}
        one["total_seconds"] = planted
    file.write_text("".join(json.dumps(one) + "\n" for one in records))


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Run two suites; return the folder that contains their result folders
    `a` and `b`.
    """
    where = tmp_path_factory.mktemp("made")
    for name, depths in (("a", "1"), ("b", "2")):
        (where / f"{name}.toml").write_text(suite(depths=depths, repeats=2))
        mb.run(where / f"{name}.toml", out=where / name, plugins=[TOY_PROBLEM])
    return where


@pytest.fixture
def stored(made, tmp_path):
    """Return copies of the two result folders of `made`."""
    for name in "ab":
        shutil.copytree(made / name, tmp_path / name)
    return tmp_path / "a", tmp_path / "b"


# growth

GROWN = {
    "solvers": '"exact", "lax", { name = "exact", label = "again" }',
    "depths": "1, 2, 3", "tolerances": "[1e-6, 1e-4]", "repeats": 2,
}  # fmt: skip


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """Return a folder with the results `before` and their continuation `grown`.

    `grown` is a copy of `before`, continued with a suite that has additional cases,
    solvers and tolerances.
    """
    where = tmp_path_factory.mktemp("campaign")
    for name, asked in (("before", {"repeats": 2}), ("grown", GROWN)):
        (where / f"{name}.toml").write_text(suite(**asked))
        mb.run(where / f"{name}.toml", out=where / name, plugins=[TOY_PROBLEM])
        if name == "before":
            shutil.copytree(where / name, where / "grown")
    return where


def test_an_extended_suite_measures_only_missing_results(campaign):
    before, after = (
        next((campaign / name / "journal").glob("*.jsonl")).read_bytes()
        for name in ("before", "grown")
    )
    records = read_journal(campaign / "grown")

    assert after.startswith(before)  # existing lines are unchanged
    assert len(records) == len({r.run_id for r in records}) == 3 * 3 * 2 * 2
    first, second = dict.fromkeys(r.session for r in records)
    old = {(r.solver, r.case) for r in records if r.session == first}
    assert {s for s, _ in old} == {"exact", "lax"}
    assert sum(r.session == second for r in records) == 36 - 8
    assert '"depth" = [1, 2, 3]' in (campaign / "grown/suite.toml").read_text()
    again = mb.run(
        campaign / "grown.toml", out=campaign / "grown", plugins=[TOY_PROBLEM]
    )
    assert len(again) == 36  # no measurement is missing


def test_solvers_of_different_sessions_are_compared_on_their_common_cases(campaign):
    run = read_measurements(campaign / "grown")
    sessions = run.df.groupby("solver").session.nunique()
    (row,) = (r for r in rows(run) if r.accuracy == 1e-6)

    assert sessions.to_dict() == {"exact": 2, "lax": 2, "again": 1}
    # lax is not accurate enough at any of its tolerances
    assert {e.solver: e.met for e in row.ranked} == {"exact": 3, "again": 3}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"time_limit": 5}, r"time_limit is 60 in .*, 5 in the suite.*another --out"),
        (
            {"solvers": '{name = "exact", options = {factor = 1.5}}, "lax"'},
            "contains exact with factor = 1.0, now 1.5; use a different label for",
        ),
    ],
)
def test_a_change_that_would_mix_two_suites_is_refused(
    campaign, measure, tmp_path, change, said
):
    shutil.copytree(campaign / "before", tmp_path / "out")
    held = (tmp_path / "out/suite.toml").read_text()
    with pytest.raises(mb.InputError, match=said):
        measure(**change)

    assert (tmp_path / "out/suite.toml").read_text() == held
    assert len(measure().records) == 8


# merging


def test_parts_of_a_campaign_are_merged_into_one_folder(measure, tmp_path):
    measure("a", depths="1")
    measure("b", depths="2", solvers='"exact", "liar"')
    merged = mb.merge(tmp_path / "a", tmp_path / "b", out=tmp_path / "all")
    held = read_journal(tmp_path / "all")

    assert held == list(merged.records)
    assert {r.run_id for r in held} == {
        r.run_id for name in "ab" for r in read_journal(tmp_path / name)
    }
    assert all(is_stored(tmp_path / "all", r.vectors) for r in held)
    texts = {(tmp_path / name / "suite.toml").read_text() for name in ("a", "all")}
    assert len(texts) == 1
    measure("all", depths="1, 2", solvers='"exact", "lax", "liar"')  # continues the run
    assert len(read_journal(tmp_path / "all")) == 2 * 3 * 2


def test_equal_measurements_of_two_machines_are_kept_and_reported_apart(
    measure, campaign, tmp_path, environment
):
    shutil.copytree(campaign / "before", tmp_path / "a")
    environment["machine"] = {"cpu": "two"}
    measure("b")
    orders = [
        {r.to_json() for r in mb.merge(*sources, out=tmp_path / out).records}
        for out, sources in (
            ("ab", (tmp_path / "a", tmp_path / "b")),
            ("ba", (tmp_path / "b", tmp_path / "a")),
        )
    ]
    records = read_journal(tmp_path / "ab")
    found = read_measurements(tmp_path / "ab")
    page = markdown(compose(found))

    assert orders[0] == orders[1]
    assert len(records) == len({r.identity for r in records}) == 16
    assert len({r.run_id for r in records}) == 8
    digests = [*dict.fromkeys(r.environment for r in records)]
    assert [environment_of(tmp_path / "ab", d)["machine"]["cpu"] for d in digests] == [
        "one", "two",
    ]  # fmt: skip
    assert set(found.solvers) == {"exact", "lax"}
    for digest in digests:
        assert [*found.only(environment=digest).answers.repeats] == [2] * 4
    assert "## Answer (one" in page
    assert "## Answer (two" in page


def test_two_sessions_on_one_machine_are_kept_and_pooled(measure, campaign, tmp_path):
    """The second session measures a part of the first one again."""
    first = measure("a", depths="1")
    shutil.copytree(campaign / "before", tmp_path / "b")
    merged = mb.merge(tmp_path / "a", tmp_path / "b", out=tmp_path / "all")
    answers = read_measurements(tmp_path / "all").answers

    assert merged.records[:4] == first.records
    assert merged.records[4:] == tuple(read_journal(tmp_path / "b"))
    assert [*answers[answers.case == "well/dual"].repeats] == [4, 4]


def renamed(journal, old, new):
    for path in journal.glob("*.jsonl"):
        path.write_text(path.read_text().replace(old, new))


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (
            lambda a, b: (b / "vectors/x.npz").symlink_to("/etc/passwd"),
            "is a link, pipe",
        ),
        (
            lambda a, b: (b / "journal/x.jsonl").write_text("{}\n"),
            "journal line: Object missing required field",
        ),
        (
            lambda a, b: (b / "suite.toml").write_text('name = "b"\ntime_limit = 5\n'),
            r"time_limit is 60 in .*/a/.*, 5 in .*/b/.*; expected equal settings",
        ),
        (
            lambda a, b: renamed(b / "journal", '"solver":"lax"', '"solver":"exact"'),
            "b contains exact with name = 'lax', now 'exact'; use a different label",
        ),
        (
            lambda a, b: (b / "suite.toml").write_text("solvers = 1\n"),
            "solvers = 1; expected",
        ),
        (lambda a, b: shutil.rmtree(b / "journal"), "no journal in"),
    ],
)
def test_incompatible_folders_are_refused_before_anything_is_written(
    stored, tmp_path, damage, said
):
    a, b = stored
    damage(a, b)
    with pytest.raises(mb.InputError, match=said):
        mb.merge(a, b, out=tmp_path / "all")

    assert not (tmp_path / "all").exists()


def test_the_folder_of_a_run_cannot_be_the_merge_target(stored, tmp_path):
    a, b = stored
    with pytest.raises(
        mb.InputError, match=r"contains measurements \(journal/.*; expected a new"
    ):
        mb.merge(a, out=b)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/suite.toml").write_text("mine")
    with pytest.raises(mb.InputError, match="is not a result folder"):
        mb.merge(a, b, out=tmp_path / "mine")
    assert (tmp_path / "mine/suite.toml").read_text() == "mine"


def test_a_killed_merge_loses_and_duplicates_nothing(stored, tmp_path):
    """The merge is killed before and after each file that it writes."""
    a, b = stored
    whole = read_all(mb.merge(a, b, out=tmp_path / "whole"))
    ends = {}
    for instant in range(100):
        out = tmp_path / f"out{instant}"
        ends[instant] = killed_merge([a, b], out, instant)
        if not (out / "journal/merged.jsonl").exists():
            mb.merge(a, b, out=out)
        assert read_all(mb.load(out)) == whole
        assert not list(out.rglob("*.tmp"))
        if ends[instant] == 0:
            break
    assert set(ends.values()) == {-signal.SIGKILL, 0}
    assert len(ends) > 5


def killed_merge(folders, out, instant):
    """Merge in a process that is killed when it writes file number `instant`."""
    if child := os.fork():
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    left = iter(range(instant))
    put = os.replace

    def put_or_die(*paths):
        if next(left, None) is None:
            os.kill(os.getpid(), signal.SIGKILL)
        put(*paths)

    os.replace = put_or_die
    mb.merge(*folders, out=out)
    os._exit(0)


def read_all(results):
    return [r.to_json() for r in results.records]


# commands of CI jobs


def test_a_strict_run_fails_if_a_claim_is_refuted_or_a_solver_fails(
    command, tmp_path, monkeypatch
):
    monkeypatch.setattr(mb, "report", lambda *_, **__: mb.Report(files=()))
    asked = ("run", "s.toml", "--plugin", TOY_PROBLEM, "--repeats", 1)
    (tmp_path / "s.toml").write_text(
        suite('"exact", "picky", "liar", "lost"', depths="2")
    )

    code, out, _ = command(*asked, "--strict")
    assert code == 1
    assert out.splitlines()[-1] == (
        "strict: measurements: 1 refuted (liar on well/depth=2/dual) and 1 without an "
        "answer (lost on well/depth=2/dual)"
    )
    good = (*asked, "--solver", "exact", "--solver", "picky")
    assert (
        command(*good, "--strict")[0] == 0
    )  # one declined; other solvers are not selected
    code, out, _ = command(*asked, "--strict", "--json")
    told = json.loads(out)
    assert code == 1
    assert told["solvers"]["exact"] == {"verified": 1}
    assert [one["solver"] for one in told["refuted"]] == ["liar"]
    assert [(one["solver"], one["status"]) for one in told["failed"]] == [
        ("lost", "failed")
    ]
    assert told["not_measured"] == []


@pytest.mark.usefixtures("blank_figures")
def test_a_report_fails_on_the_requested_conditions_and_says_so(
    command, measure, tmp_path, monkeypatch
):
    """A solver takes ten times as long in folder b; another solver makes a false claim
    in folder c.
    """
    monkeypatch.setenv("STARTS", str(tmp_path / "starts"))
    slow = '{{ name = "slow", label = "{}", options.seconds = {} }}'
    honest, liar = slow.format("old", 0.002), '{ name = "liar", label = "old" }'
    for name, seconds, old in (
        ("a", 0.002, honest),
        ("b", 0.02, honest),
        ("c", 0.002, liar),
    ):
        solvers = f"{slow.format('new', seconds)}, {old}"
        measure(name, solvers=solvers, depths="2, 3, 4")
        plant_times(tmp_path / name, new=seconds, old=0.002)

    assert command("report", "a", "b", "--fail-on", "worse", "--format", "csv")[0] == 0
    gates = ("--fail-on", "worse,slower=1.5", "--format", "csv", "--json")
    code, out, _ = command("report", "a", "b", *gates)
    told = json.loads(out)
    assert (code, told["failed_on"]) == (1, ["slower"])
    new, old = told["changes"]
    assert (new["after"], new["outcome"], new["cells"]) == ("new", "slower", 3)
    assert new["low"] > 1.5
    assert (old["after"], old["outcome"], old["worse"]) == ("old", "not_slower", [])
    code, out, _ = command(
        "report", "a", "b", "c", "--fail-on", "worse", "--format", "md"
    )
    assert code == 1
    assert out.splitlines()[-1] == "failed on worse"
    assert "c/report/against-a/report.md" in out
    assert "worse: old on 3 cells, such as well/depth=2/dual: verified →" in out
    assert command("report", "a", "c", "--format", "csv")[0] == 0  # without --fail-on


def test_two_solvers_of_one_run_are_compared(command, measure, tmp_path, monkeypatch):
    monkeypatch.setenv("STARTS", str(tmp_path / "starts"))
    slow = '{{ name = "slow", label = "{}", options.seconds = {} }}'
    solvers = f"{slow.format('old', 0.002)}, {slow.format('new', 0.005)}"
    measure("a", solvers=solvers, depths="2, 3", repeats=3)
    plant_times(tmp_path / "a", old=0.002, new=0.005)
    asked = ("--format", "csv", "--fail-on", "slower=1.2")

    code, out, _ = command("report", "a", "--compare", "old,new", *asked)
    assert code == 1
    assert out.startswith("Changed: new.seconds 0.002 → 0.005.\nslower: new")
    assert command("report", "a", "--compare", "new,old", *asked)[0] == 0
    assert command("report", "a", "a", "--pair", "old=new", *asked)[0] == 1


def test_conditions_that_cannot_be_judged_exit_with_2_and_the_reason(
    command, stored, measure
):
    code, _, err = command("report", "a", "--fail-on", "worse")
    assert code == 2
    assert "fail-on and pair need two folders, or two solvers" in err
    code, out, _ = command("report", "a", "b", "--fail-on", "slower")
    assert code == 2
    assert "cannot tell: exact has no cell that was verified both times" in out
    code, _, err = command("report", "a", "b", "--fail-on", "slowr")
    assert (code, "expected worse, slower, or slower=FACTOR" in err) == (2, True)
    code, _, err = command("report", "a", "--compare", "exact,lx", "--format", "csv")
    assert (code, "did you mean 'lax'" in err) == (2, True)


def test_folders_are_merged_from_the_command_line(command, stored):
    code, out, _ = command("merge", "a", "b", "--out", "all")
    assert code == 0
    assert out.splitlines()[-1] == "all: 8 measurements"
    code, out, err = command("merge", "a", "nowhere", "--out", "more")
    assert (code, out) == (2, "")
    assert "nowhere: no such folder; expected a result folder of `run`" in err


def contents(folder):
    return {
        path.relative_to(folder): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


@pytest.mark.parametrize(
    ("out", "said"),
    [
        ("b", "is, contains or lies inside"),
        ("./a/", "is, contains or lies inside"),
        ("a/../b", "is, contains or lies inside"),
        ("link", "is, contains or lies inside"),
        ("a/journal", "lies inside"),
        ("b/vectors/new", "lies inside"),
        ("link/journal", "lies inside"),
        (".", "lies inside"),
    ],
)
def test_a_merge_into_one_of_its_sources_is_refused_in_one_line(
    command, stored, tmp_path, out, said
):
    a, b = stored
    (tmp_path / "link").symlink_to(a)
    before = contents(a), contents(b)

    code, printed, err = command("merge", "a", "b", "--out", out)

    assert (code, printed) == (2, "")
    assert len(err.splitlines()) == 1
    assert said in err
    assert (contents(a), contents(b)) == before
    assert {path.name for path in tmp_path.iterdir()} == {"a", "b", "link"}
