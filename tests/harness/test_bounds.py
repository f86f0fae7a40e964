"""Limits on user input: one-line error messages that state the admissible values."""

import json
import os

import pytest

from mortarbench.harness import InputError
from mortarbench.harness.errors import one_line, shown
from mortarbench.harness.files.reading import read_json, read_toml, toml
from mortarbench.harness.names import parse
from mortarbench.harness.record import Record, Verdict
from mortarbench.harness.results.journal import read_journal
from mortarbench.harness.suite.suite import load_suite
from mortarbench.problems import PROBLEMS
from mortarbench.solvers import SOLVERS
from tests.support.refusals import refused

SUITE = 'name = "s"\nsolvers = ["osqp"]\n[[problems]]\nfamily = "beam-ring"\n'


def record(run_id="a", **changes):
    blank = Record(
        run_id=run_id, case="tiny/plain", family="tiny", params={"h": 1.0},
        form="plain", sizes={}, solver="a", options={}, tol=1e-6, repeat=0, block=0,
        status=Verdict.VERIFIED,
    )  # fmt: skip
    return blank.replace(**changes)


@pytest.fixture
def journal(tmp_path):
    """Return a function that writes lines, records or changed fields of a record to a
    journal; it returns the result folder.
    """

    def journal(*entries):
        (tmp_path / "journal").mkdir(exist_ok=True)
        lines = []
        for entry in entries:
            if isinstance(entry, dict):
                entry = json.dumps(json.loads(record().to_json()) | entry)
            lines.append(entry if isinstance(entry, str) else entry.to_json())
        file = tmp_path / "journal" / "here.jsonl"
        file.write_bytes("".join(f"{line}\n" for line in lines).encode())
        return tmp_path

    return journal


@pytest.mark.parametrize(
    ("changed", "expected"),
    [
        ({"tol": 0}, "tol: Expected `float` > 0"),
        ({"solve_seconds": -2e-6}, "solve_seconds: Expected `float` >= 0"),
        ({"ranks": 0}, "ranks: Expected `int` >= 1"),
        ({"repeat": 10**30}, "repeat: Expected `int` <= "),
        ({"quantities": {"a": [[2**63]]}}, "quantities[...][0][0]: Expected `int` <="),
        ({"status": "fine"}, "'fine'; expected one of verified, verified_infeasible"),
        ({"params": {"n": [1]}}, "params[...]: Expected `bool | int | float"),
        ({"run_id": ""}, "run_id: Expected `str` of length >= 1"),
        ({"options": {"x": [[[[[[[[[1]]]]]]]]]}}, "[0][0][0]: Expected `bool"),
        ({"message": 10**5000 // 7 % 10**300}, "message: Expected `str`"),
    ],
)
def test_a_journal_line_with_an_impossible_value_is_named(journal, changed, expected):
    folder = journal(record("b"), changed)

    with pytest.raises(InputError) as e:
        read_journal(folder)
    assert expected in str(e.value)
    assert str(e.value).startswith(f"{folder}/journal/here.jsonl, line 2: ")
    assert len(str(e.value)) < len(str(folder)) + 400


@pytest.mark.parametrize("value", ["NaN", "Infinity", "1e400", "9" * 5000, "[" * 9000])
def test_values_that_json_or_its_readers_cannot_represent_are_refused(journal, value):
    line = record().to_json().replace('"gap":null', f'"gap":{value}')

    with pytest.raises(InputError, match="line 1: "):
        read_journal(journal(line))


def test_numbers_that_readers_refuse_are_written_as_null():
    row = json.loads(record(counts={"n": 2**63}, gap=float("inf")).to_json())

    assert row["counts"] == {"n": None}
    assert row["gap"] is None


def test_tables_of_any_depth_are_written_so_that_they_can_be_read():
    deep = [1, "\ud800"]
    for _ in range(30):
        deep = {"a": deep}

    line = record(quantities={"b": deep, "c": [float("nan")]}).to_json()
    assert Record.from_json(line).quantities["c"] == [None]


def test_extreme_values_that_are_possible_are_read_as_they_are(journal):
    odd = {
        "objective": -1e308, "gap": 1e308, "iterations": 0, "message": "\x00\u202e",
        "counts": {"": None, "n": 2**63 - 1}, "tol": 1, "unknown": [[[]]],
    }  # fmt: skip
    [r] = read_journal(journal(odd))

    assert (r.objective, r.gap, r.iterations, r.tol) == (-1e308, 1e308, 0, 1.0)
    assert r.counts == {"": None, "n": 2**63 - 1}


def test_a_repeated_line_counts_once_and_is_reported(journal):
    folder, told = journal(record("a"), record("b"), record("a"), record("a")), []

    assert [r.run_id for r in read_journal(folder, told.append)] == ["a", "b"]
    [line] = told
    assert line == "2 journal lines repeat an earlier line exactly, and count once"


def test_two_contradictory_lines_on_one_measurement_are_refused(journal):
    folder = journal(record("b"), record("a"), record("a", status=Verdict.WRONG))

    with refused("here.jsonl, line 3: differs from an earlier record of run_id 'a'; "):
        read_journal(folder)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("a = " + "[" * 5000, "nested too deeply; expected at most"),
        ("a = " + "[" * 200 + "]" * 200, "nested too deeply"),
        ("a = " + "{a=" * 3000, "nested too deeply"),
        ("a" + ".a" * 200_000 + " = 1", "nested too deeply"),
        ("[" + "a." * 200_000 + "a]", "nested too deeply"),
        ("a = " + "9" * 5000, "Exceeds the limit .4300 digits"),
        ("a = 1e", "line 1, column"),
    ],
)
def test_deeply_nested_or_malformed_toml_is_refused(text, expected):
    with pytest.raises(InputError, match=expected):
        toml(text)


def test_text_files_are_regular_utf_8_and_not_too_large(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    large = tmp_path / "large.toml"
    large.write_bytes(b"#" * 2_000_000)
    (tmp_path / "latin").write_bytes(b"a = '\xe9'")
    for path, wrong in (
        ("/dev/zero", "a device or a pipe"), (tmp_path / "pipe", "a device or a pipe"),
        (tmp_path, "a folder"), (large, "larger than 1 MiB"),
        ("a\0b", "not a valid file name"),
        (tmp_path / "latin", "not UTF-8"), (tmp_path / "none", "No such file"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=f"{wrong}.*; expected a TOML file"):
            read_toml(tmp_path / path)


@pytest.mark.parametrize(
    "text", ["[" * 9000, "[" * 99 + "]" * 99, '{"a": NaN}', "{", ""]
)
def test_invalid_json_is_refused_with_the_name_of_the_file(tmp_path, text):
    (tmp_path / "a.json").write_text(text)

    with pytest.raises(InputError, match=r"a\.json: .*expected"):
        read_json(tmp_path / "a.json")


def test_a_grid_beyond_the_limit_is_refused_with_the_way_to_raise_the_limit(tmp_path):
    path, many = tmp_path / "s.toml", list(range(1, 951))
    grid = f"params = {{ Nr = {many}, Nh = {many}, step = 1 }}\nforms = ['dual']\n"
    path.write_text(SUITE + grid)
    with pytest.raises(InputError, match="spans 902500 cases; expected at most 100000"):
        load_suite(path, PROBLEMS, SOLVERS)

    few = f"params = {{ Nr = {many[:3]}, step = 1 }}\nforms = ['dual']\n"
    path.write_text(f"max_cases = 2\n{SUITE}{few}")
    with pytest.raises(InputError, match="set max_cases = 3 in the suite"):
        load_suite(path, PROBLEMS, SOLVERS)
    path.write_text(f"max_cases = 3\n{SUITE}{few}")
    assert len(load_suite(path, PROBLEMS, SOLVERS).cases.all) == 3


@pytest.mark.parametrize(
    "name",
    [
        "beam-ring/Nr=1_0/dual", "beam-ring/Nr=\u0661/dual",
        "hertz-plane/load=1_0/dual",
        "hertz-plane/load=nan/dual", "hertz-plane/load=1e400/dual",
        "hertz-plane/load=1e308/dual", "hertz-plane/load=1e-320/dual",
        "hertz-plane/halvings=9000000000000000000/dual", "beam-ring/Nr=1000000000/dual",
        "beam-ring/steps=100000000000000000000/dual", "beam-ring/steps=1000000/dual",
        "obstacle/n=1000000000/primal", "contact-patch/lower=1000000000/dual",
        "beam-ring/Nr=" + "9" * 5000 + "/dual",
        "beam-ring/" + "x" * 100_000 + "=1/dual",
        "bodies:a\0b.toml/dual", "y" * 100_000 + "/dual", "beam-ring/" + "z" * 100_000,
    ],
)  # fmt: skip
def test_impossible_cases_are_refused_with_a_short_message(name):
    with pytest.raises(InputError) as e:
        parse(name, PROBLEMS)
    assert len(str(e.value)) < 600
    assert not any(letter * 201 in str(e.value) for letter in "9xyz")


def test_a_message_is_one_line_of_limited_length_in_which_paths_fit(tmp_path):
    deep = tmp_path / ("d" * 200) / ("e" * 200)
    deep.mkdir(parents=True)

    assert one_line(f"{deep}: what\nis it") == f"{deep}: what is it"
    assert one_line(f"unknown {'q' * 5000!r}; known: a, b").endswith("; known: a, b")
    assert len(one_line("word " * 5000)) == 1000
    assert shown([1] * 5000).startswith("[1, 1")
    assert len(shown([1] * 5000)) == 200
    nested = []
    for _ in range(100_000):
        nested = [nested]
    assert shown(nested) == "a list too long to show"
