"""Campaigns that grow, are merged and gate a CI: real runs of toy problems."""

import os
import shutil
import signal
from contextlib import suppress

import pytest

import mortarbench as mb
from harness.files.reading import read_toml
from harness.files.store import is_stored
from harness.results.folder import environment_of
from harness.results.journal import read_journal
from mortarbench.registries import Registries
from reports.data.evidence import read_evidence
from reports.folder import compose
from reports.render.markdown import markdown
from tests.support import TOY_PROBLEM


def suite(solvers='"exact", "lax"', depths="1, 2", **settings):
    lines = [f"{key} = {value}" for key, value in settings.items()]
    head = f'name = "c"\nsolvers = [{solvers}]\n' + "\n".join(lines)
    return (
        f'{head}\n[[problems]]\nfamily = "well"\nforms = ["dual"]\n'
        f"params = {{ depth = [{depths}] }}\n"
    )


@pytest.fixture(autouse=True)
def environment(monkeypatch):
    """What runs find out of this machine, in no time; a test may say otherwise."""
    here = {"machine": {"cpu": "one"}}
    monkeypatch.setattr(Registries, "environment", lambda _: here)
    return here


@pytest.fixture
def measure(tmp_path):
    """Run a suite, given as for `suite`, into a folder of that name."""

    def measure(out="out", **asked):
        file = tmp_path / f"{out}.toml"
        file.write_text(suite(**({"repeats": 2} | asked)))
        return mb.run(file, out=tmp_path / out, plugins=[TOY_PROBLEM])

    return measure


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Two folders of a campaign, as runs leave them."""
    where = tmp_path_factory.mktemp("made")
    for name, depths in (("a", "1"), ("b", "2")):
        (where / f"{name}.toml").write_text(suite(depths=depths))
        mb.run(where / f"{name}.toml", out=where / name, plugins=[TOY_PROBLEM])
    return where


@pytest.fixture
def stored(made, tmp_path):
    """A copy of these folders."""
    for name in "ab":
        shutil.copytree(made / name, tmp_path / name)
    return tmp_path / "a", tmp_path / "b"


# growth


def test_of_a_suite_that_grew_only_the_missing_is_measured(measure, tmp_path):
    measure()
    before = (tmp_path / "out/journal").glob("*.jsonl").__next__().read_bytes()
    grown = {
        "solvers": '"exact", "lax", "near"', "depths": "1, 2, 3",
        "tolerances": "[1e-6, 1e-4]",
    }  # fmt: skip
    measure(**grown)
    after = next((tmp_path / "out/journal").glob("*.jsonl")).read_bytes()
    records = read_journal(tmp_path / "out")

    assert after.startswith(before)  # not a byte of it was touched
    assert len(records) == len({r.run_id for r in records}) == 3 * 3 * 2 * 2
    first, second = dict.fromkeys(r.session for r in records)
    old = {(r.solver, r.case) for r in records if r.session == first}
    assert {s for s, _ in old} == {"exact", "lax"}
    assert sum(r.session == second for r in records) == 36 - 8
    assert "depth = [1, 2, 3]" in (tmp_path / "out/suite.toml").read_text()
    assert len(measure(**grown).records) == 36  # nothing is left


def test_solvers_of_different_sessions_are_compared_unpaired_and_it_is_said(
    measure, tmp_path
):
    measure()
    measure(solvers='"exact", "lax", { name = "exact", label = "again" }')
    evidence = read_evidence(tmp_path / "out")
    said = markdown(compose(evidence))

    assert "Measured in different sessions" in said
    assert "again with exact, lax" in said
    assert "Unpaired: the two were not measured in the same blocks" in said
    row = evidence.outcomes["well/dual", 1e-6]
    assert not row["again"].by_block.keys() & row["exact"].by_block.keys()
    assert row["lax"].by_block.keys() == row["exact"].by_block.keys()


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"depths": "2"}, "holds well/dual, which the suite has no longer"),
        ({"time_limit": 5}, r"time_limit was 60, now 5\); choose another --out"),
        (
            {"solvers": '{name = "exact", options = {factor = 1.5}}, "lax"'},
            "holds exact with factor = 1.0, now 1.5; give other options another label",
        ),
    ],
)
def test_what_would_mix_two_suites_is_refused(measure, tmp_path, change, said):
    measure()
    held = (tmp_path / "out/suite.toml").read_text()
    with pytest.raises(mb.InputError, match=said):
        measure(**change)

    assert (tmp_path / "out/suite.toml").read_text() == held
    assert len(measure().records) == 8


# merging


def test_parts_of_a_campaign_become_one_folder(measure, tmp_path):
    measure("a", depths="1")
    measure("b", depths="2", solvers='"exact", "liar"')
    again = []
    merged = mb.merge(tmp_path / "a", tmp_path / "b", out=tmp_path / "all")
    mb.merge(tmp_path / "a", tmp_path / "b", out=tmp_path / "all", tell=again.append)
    held = read_journal(tmp_path / "all")

    assert held == list(merged.records)
    assert {r.run_id for r in held} == {
        r.run_id for name in "ab" for r in read_journal(tmp_path / name)
    }
    assert [line.rpartition(": ")[2] for line in again] == [
        "4 of 4 are there already, and count once"
    ] * 2
    assert all(is_stored(tmp_path / "all", r.vectors) for r in held)
    assert read_toml(tmp_path / "all/suite.toml") == {
        "name": "c", "solvers": ["exact", "lax", "liar"], "repeats": 2,
        "problems": [
            {"family": "well", "forms": ["dual"], "params": {"depth": [depth]}}
            for depth in (1, 2)
        ],
    }  # fmt: skip
    measure("all", depths="1, 2", solvers='"exact", "lax", "liar"')  # it goes on
    assert len(read_journal(tmp_path / "all")) == 2 * 3 * 2


def test_the_same_of_two_machines_is_kept_apart_and_marked(
    measure, tmp_path, environment
):
    measure("a")
    environment["machine"] = {"cpu": "two"}
    measure("b")
    orders = [
        {
            r.but(run_id="").to_json()
            for r in mb.merge(
                tmp_path / x, tmp_path / y, out=tmp_path / f"{x}{y}"
            ).records
        }
        for x, y in ("ab", "ba")
    ]
    records = read_journal(tmp_path / "ab")
    evidence = read_evidence(tmp_path / "ab")
    said = markdown(compose(evidence))

    assert orders[0] == orders[1]
    assert len(records) == len({r.run_id for r in records}) == 16
    digests = [*dict.fromkeys(r.environment for r in records)]
    assert [environment_of(tmp_path / "ab", d)["machine"]["cpu"] for d in digests] == [
        "one", "two",
    ]  # fmt: skip
    mark = f"@{digests[1][:6]}"
    assert set(evidence.solvers) == {"exact", "lax", f"exact {mark}", f"lax {mark}"}
    assert all(len(o.records) == 2 for o in evidence.flat)
    assert f"{mark} is two (other: machine.cpu)" in said
    assert "not made yet" not in said
    mb.merge(tmp_path / "ba", tmp_path / "a", out=tmp_path / "ab")  # nothing new
    assert read_journal(tmp_path / "ab") == records


def test_what_was_measured_twice_in_one_environment_counts_once(measure, tmp_path):
    first = measure("a", depths="1")
    measure("b", depths="1, 2")
    merged = mb.merge(tmp_path / "a", tmp_path / "b", out=tmp_path / "all")

    assert merged.records[:4] == first.records
    assert len(merged) == 8
    row = read_evidence(tmp_path / "all").outcomes["well/dual", 1e-6]
    assert [len(o.records) for o in row.values()] == [2, 2]


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (
            lambda a, b: (b / "vectors/x.npz").symlink_to("/etc/passwd"),
            "is a link, pipe",
        ),
        (
            lambda a, b: (b / "journal/x.jsonl").write_text("{}\n"),
            "journal line of sch",
        ),
        (
            lambda a, b: (b / "suite.toml").write_text("time_limit = 5\n"),
            r"time_limit is 60 in .*a, 5 in .*b; expected suites whose measurements",
        ),
        (
            lambda a, b: (b / "suite.toml").write_text(
                'solvers = [{ name = "lax", label = "exact" }]\n'
            ),
            "label 'exact' is {'name': 'exact'} in .* expected one solver for a label",
        ),
        (lambda a, b: (b / "suite.toml").write_text("solvers = 1\n"), "is no suite"),
        (lambda a, b: shutil.rmtree(b / "journal"), "no journal in"),
    ],
)
def test_folders_that_cannot_be_one_are_refused_before_anything_is_written(
    stored, tmp_path, damage, said
):
    a, b = stored
    damage(a, b)
    with pytest.raises(mb.InputError, match=said):
        mb.merge(a, b, out=tmp_path / "all")

    assert not (tmp_path / "all").exists()


def test_a_run_or_one_of_the_folders_is_no_place_to_merge_into(stored, tmp_path):
    a, b = stored
    with pytest.raises(mb.InputError, match="is one of the folders to merge"):
        mb.merge(a, b, out=b)
    with pytest.raises(mb.InputError, match=r"holds measurements of a run \(journal/"):
        mb.merge(a, out=b)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine/suite.toml").write_text("mine")
    with pytest.raises(mb.InputError, match="is no result folder"):
        mb.merge(a, b, out=tmp_path / "mine")
    assert (tmp_path / "mine/suite.toml").read_text() == "mine"


def test_a_merge_that_is_killed_anywhere_loses_and_doubles_nothing(stored, tmp_path):
    """At every file that it puts in place, before and after."""
    a, b = stored
    whole = read_all(mb.merge(a, b, out=tmp_path / "whole"))
    ends = {}
    for instant in range(100):
        out = tmp_path / f"out{instant}"
        ends[instant] = killed_merge([a, b], out, instant)
        if (out / "journal").exists():
            with suppress(mb.InputError):
                assert read_all(mb.load(out)) == whole
        again = mb.merge(a, b, out=out)
        assert read_all(again) == read_all(mb.load(out)) == whole
        assert not list(out.rglob("*.tmp"))
        if ends[instant] == 0:
            break
    assert set(ends.values()) == {-signal.SIGKILL, 0}
    assert len(ends) > 5


def killed_merge(folders, out, instant):
    """Merge in a process that is killed as it puts file number `instant` in place."""
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
