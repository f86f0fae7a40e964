"""Campaigns that grow, are merged and gate a CI: real runs of toy problems."""

import pytest

import mortarbench as mb
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
