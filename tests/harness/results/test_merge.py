"""Merges of sessions: a measurement is known by its session and its run_id."""

import json

import numpy as np
import pytest

from mortarbench.harness import InputError
from mortarbench.harness.results.journal import Journal, read_journal
from mortarbench.harness.results.merge import merge
from tests.support.box_records import box_record

SUITE = 'name = "boxes"\nrepeats = 3\nsolvers = ["fast", "slow"]\n'


@pytest.fixture
def session(tmp_path):
    """Write a result folder with one session of the same suite; return the folder."""

    def session(name, factor=1.0, **changes):
        rng = np.random.default_rng(sum(map(ord, name)))
        environment = {"digest": changes.setdefault("environment", "e1")}
        folder = tmp_path / name
        with Journal(folder, "e") as journal:
            for solver, time in (("fast", 0.02), ("slow", 0.05)):
                for case in range(4):
                    for repeat in range(3):
                        seconds = factor * time * rng.lognormal(0, 0.1)
                        journal.append(
                            box_record(
                                solver, case, seconds, repeat, session=name, **changes
                            )
                        )
        (folder / "suite.toml").write_text(SUITE)
        (folder / "environment.json").write_text(json.dumps(environment))
        return folder

    return session


def lines(folder):
    return [r.to_json() for r in read_journal(folder)]


def test_a_merge_of_two_sessions_keeps_every_measurement_unchanged(session, tmp_path):
    """Both sessions have the same run_ids, but different times."""
    a, b = session("a"), session("b", factor=2.0)
    ids = [{r.run_id for r in read_journal(folder)} for folder in (a, b)]
    assert ids[0] == ids[1]

    merged = merge([a, b], tmp_path / "both")

    assert [r.to_json() for r in merged] == lines(tmp_path / "both")
    assert lines(tmp_path / "both") == lines(a) + lines(b)
    assert len({r.identity for r in merged}) == len(merged) == 48


def test_merges_of_overlapping_folders_write_each_measurement_once(session, tmp_path):
    a, b, c = session("a"), session("b"), session("c", environment="e2")
    merge([a, b], tmp_path / "ab")
    merge([b, c], tmp_path / "bc")
    told = []

    merge([tmp_path / "ab", tmp_path / "bc"], tmp_path / "all", told.append)

    assert lines(tmp_path / "all") == lines(a) + lines(b) + lines(c)
    assert [line.partition(": ")[2] for line in told] == [
        "24 of 48 measurements are already present and are counted once"
    ]


def test_two_records_of_one_measurement_are_refused(session, tmp_path):
    a = session("a")
    changed = tmp_path / "changed"
    with Journal(changed, "e") as journal:
        for r in read_journal(a):
            journal.append(r.replace(total_seconds=9.0))
    with pytest.raises(InputError, match="differs from that of another folder"):
        merge([a, changed], tmp_path / "out")

    assert not (tmp_path / "out").exists()
