"""Damaged or unusual input is accepted or refused without a traceback or a hang.

The inputs are suites, descriptions of bodies, names of cases, files of result folders,
solver options, command lines and arguments from Python. Files with QPs are tested in
`tests/harness/files/test_hostile_files.py`.
"""

import json
import random
import shutil
import warnings
from decimal import Decimal
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

import mortarbench as mb
from mortarbench.cli.main import main
from mortarbench.harness import InputError, Solution, Status
from mortarbench.harness.files.reading import toml
from mortarbench.harness.files.store import (
    load_fields,
    load_solution,
    point_arrays,
    save,
)
from mortarbench.harness.names import parse
from mortarbench.harness.registry import SolverSpec
from mortarbench.harness.results.folder import environment_of, refuse_other
from mortarbench.harness.results.journal import read_journal
from mortarbench.harness.suite.solver_options import (
    listed_options,
    parse_options,
    sweep,
)
from mortarbench.harness.suite.suite import as_toml, load_suite, read_suite
from mortarbench.problems import PROBLEMS
from mortarbench.problems.contact.bodies import assemble_stiffness
from mortarbench.problems.families.description import read_bodies
from mortarbench.registries import Registries
from mortarbench.reports.folder import write_report
from mortarbench.reports.measurements import read_measurements
from mortarbench.reports.sections import compose
from mortarbench.solvers import SOLVERS
from tests.support import damaged_files, damaged_texts, synthetic_results
from tests.support.bounded import bounded
from tests.support.gmsh_files import stacked_blocks

FEW, MANY = 30, 1000
COUNTS = pytest.mark.parametrize(
    "count", [FEW, pytest.param(MANY, marks=pytest.mark.slow)]
)

SUITE = """\
name = "demo"
tolerances = [1e-6, 1e-3]
repeats = 3
time_limit = 60
memory_limit = 4096.0
null_arm = "osqp"
solvers = ["osqp", { name = "clarabel", label = "few", options = { max_iter = 200 } }]

[[problems]]
family = "beam-ring"
forms = ["primal", "dual"]
params = { Nr = [4, 12], Nh = [3, 6], step = [1, 5, 10] }
zip = [["Nr", "Nh"]]

[[problems]]
family = "hertz-plane"
params = { n = 4, load = [1.0, 2.5] }
sequence = "load"
"""
NAMES = (
    "beam-ring/Nr=30/Nh=15/step=10/dual", "hertz-plane/n=4/load=2.5/primal",
    "obstacle/dim=2/n=20/dual-bounds", "contact-patch/ratio=1.5/lower=3/dual",
    "bodies:press.toml/steps=2/primal", "file:a.npz",
)  # fmt: skip
NESTED = ("params", "sizes", "options", "counts", "reported", "quantities")
ENVIRONMENT = {
    "digest": "8c2f9a56e00f", "now": {"load": 0.1, "time": "2026-11-21"},
    "machine": {"cpu": "a processor", "usable_cores": 2, "memory_mib": 8192},
    "versions": {"numpy": "2.0"}, "plugins": ["a.py"],
    "threads": [{"library": "openblas", "threads": 1}], "variables": {},
}  # fmt: skip


def tried(text, read):
    """Read a text; return True if it was accepted. Only InputError may be raised."""
    try:
        with bounded(), warnings.catch_warnings():
            warnings.simplefilter("error")
            read()
    except InputError:
        return False
    except BaseException as e:
        e.add_note(f"of the text {text!r:.3000}")
        raise
    return True


def written(path, text):
    path.write_bytes(text.encode("utf-8", "surrogatepass"))
    return path


@COUNTS
def test_a_damaged_suite_is_read_or_refused(tmp_path, count):
    chance, path = random.Random(count), tmp_path / "suite.toml"
    for _ in range(count):
        text = damaged_texts.damaged(SUITE, chance)
        written(path, text)
        tried(text, lambda: load_suite(path, PROBLEMS, SOLVERS))


@COUNTS
def test_a_damaged_description_of_bodies_is_read_or_refused(tmp_path, count):
    path, chance = stacked_blocks(tmp_path), random.Random(count)
    sound = path.read_text()
    assert assemble_stiffness(read_bodies(path, "strain")).K.nnz
    for _ in range(count):
        text = damaged_texts.damaged(sound, chance)
        written(path, text)
        tried(text, lambda: assemble_stiffness(read_bodies(path, "strain")))


@COUNTS
def test_a_damaged_name_of_a_case_is_read_or_refused(count):
    chance = random.Random(count)

    def read(text):
        name = parse(text, PROBLEMS)
        assert parse(str(name), PROBLEMS) == name

    for _ in range(count):
        text = damaged_texts.damaged(chance.choice(NAMES), chance)
        tried(text, lambda text=text: read(text))


def lines(count, chance):
    """Yield journal lines with unusual values, from records with distinct run_ids."""
    sound = [json.loads(r.to_json()) for r in synthetic_results.records(3, 4, 2)]
    for i in range(count):
        row = chance.choice(sound) | {"run_id": f"{i:012x}"}
        part = chance.choice((*NESTED, "message", "claimed", "started", "node", ""))
        changed = damaged_texts.distorted({part: row[part]} if part else row, chance)
        row |= changed
        text = json.dumps(row)
        yield damaged_texts.damaged(text, chance) if chance.random() < 0.3 else text


@COUNTS
def test_odd_lines_of_a_journal_are_refused_or_reported(tmp_path, count):
    journal = tmp_path / "journal" / "odd.jsonl"
    journal.parent.mkdir()
    taken = {}
    for line in lines(count, random.Random(count)):
        text = line.replace("\n", " ") + "\n"
        written(journal, text)
        if tried(text, lambda: read_journal(tmp_path)):
            taken[read_journal(tmp_path)[0].run_id] = text
    assert count / 10 < len(taken) < count
    written(journal, "".join(taken.values()))
    (tmp_path / "environment.json").write_text(json.dumps(ENVIRONMENT))

    assert tried("all that were taken", lambda: compose(read_measurements(tmp_path)))
    assert tried("", lambda: write_report(tmp_path, ("csv", "parquet")))


@COUNTS
def test_an_odd_environment_is_refused_or_reported(tmp_path, count):
    chance = random.Random(count)
    synthetic_results.write(tmp_path, 1, 1, 1)
    path = tmp_path / "environment.json"
    for i in range(count):
        text = json.dumps(
            damaged_texts.distorted(ENVIRONMENT, chance), ensure_ascii=False
        )
        text = damaged_texts.damaged(text, chance) if chance.random() < 0.3 else text
        written(path, text)
        tried(text, lambda: environment_of(tmp_path, "8c2f9a56e00f"))
        taken = tried(text, lambda: read_measurements(tmp_path))
        if taken and i % 10 == 0:
            assert tried(text, lambda: compose(read_measurements(tmp_path)))


@COUNTS
def test_a_damaged_suite_of_a_folder_is_refused_or_reported_and_merged(tmp_path, count):
    chance = random.Random(count)
    for name in ("a", "b"):
        synthetic_results.write(tmp_path / name, 1, 1, 1)
        (tmp_path / name / "suite.toml").write_text(SUITE)
    table = toml(SUITE)
    for i in range(count):
        text = (
            in_lines(without_none(damaged_texts.distorted(table, chance)))
            if i % 2
            else damaged_texts.damaged(SUITE, chance)
        )
        written(tmp_path / "b" / "suite.toml", text)
        taken = tried(text, lambda: read_measurements(tmp_path / "b"))
        if taken and i % 10 == 0:
            assert tried(text, lambda: compose(read_measurements(tmp_path / "b")))
        if i % 10 == 1:
            shutil.rmtree(tmp_path / "c", ignore_errors=True)
            folders = [tmp_path / "a", tmp_path / "b"]
            if tried(text, lambda f=folders: mb.merge(*f, out=tmp_path / "c")):
                assert tried(text, lambda: read_suite(tmp_path / "c" / "suite.toml"))
        suite = tmp_path / "s.toml"
        suite.write_text(SUITE)
        now = load_suite(suite, PROBLEMS, SOLVERS)
        tried(text, lambda now=now: refuse_other(tmp_path / "b", now, {"digest": ""}))


def in_lines(table):
    """Return a table as TOML, with one line for each key of the table."""
    return as_toml({f"{key}_": value for key, value in table.items()}).replace(
        "_ = ", " = "
    )


def without_none(data):
    """Return the data without None, which TOML cannot represent."""
    match data:
        case dict():
            return {k: without_none(v) for k, v in data.items() if v is not None}
        case list():
            return [without_none(v) for v in data if v is not None]
    return data


@COUNTS
def test_damaged_vectors_are_read_or_refused(tmp_path, count):
    chance = np.random.default_rng(count)
    point = Solution(
        status=Status.SOLVED, x=np.ones(5), y=np.ones(2), z=np.ones(0),
        z_box=np.zeros(5), iterations=3, counts={},
        history={"objective": np.arange(3.0), "step": np.array(["a", "b", "c"])},
    )  # fmt: skip
    fields = {
        "points": np.zeros((4, 2)), "cells": np.array([[0, 1, 2, 3]]),
        "bodies": np.zeros(1, dtype=int), "displacement": np.zeros((4, 2)),
    }  # fmt: skip
    digests = save(tmp_path, point_arrays(point)), save(tmp_path, fields)
    paths = [tmp_path / "vectors" / f"{digest}.npz" for digest in digests]
    whole = [path.read_bytes() for path in paths]
    for i in range(count):
        data = damaged_files.damaged(chance, whole[i % 2], whole)
        paths[i % 2].write_bytes(data)
        for load in (load_fields, load_claim):
            tried(data, lambda load=load, i=i: load(tmp_path, digests[i % 2]))


def load_claim(folder, digest):
    return load_solution(folder, digest, Status.SOLVED)


@COUNTS
def test_damaged_options_are_taken_or_refused(count):
    chance = random.Random(count)
    options = ("max_iter=50", "eps_abs=1e-8", "polish=true", "max_iter=5,10", "rho=")
    for _ in range(count):
        text = damaged_texts.damaged(chance.choice(options), chance)
        tried(text, lambda text=text: sweep(OSQP, parse_options([text]), SOLVERS))
        value = chance.choice((*damaged_texts.VALUES, *ODD))
        key = chance.choice(("max_iter", "eps_abs", "polish", *ODD))
        tried(
            (key, value),
            lambda key=key, value=value: sweep(
                OSQP,
                listed_options({key: value} if isinstance(key, str) else value),
                SOLVERS,
            ),
        )


OSQP = (SolverSpec(name="osqp", label="osqp"),)
#: values that a Python program may pass by mistake
ODD = (
    None, True, False, 0, 3, -1, 2.5, float("nan"), float("inf"), 10**400, 1j, "", "x",
    "a b", "\0", "\ud800", "x" * 5000, "nowhere/x", "/dev/zero", "/proc/self/mem", "-",
    b"x", Path("nowhere"), Path(), Path("a\0b"), (), (3,), ("x",), (None,), ("a", 5),
    frozenset({"x"}), frozenset(), range(3), str, InputError, np.float64(0.5),
    np.int64(2), np.bool_(True), np.str_("x"), Decimal(1), Fraction(1, 3), ...,
)  # fmt: skip


@COUNTS
def test_damaged_values_on_the_command_line_are_refused_in_one_line(
    tmp_path, monkeypatch, capsys, count
):
    monkeypatch.chdir(tmp_path)
    synthetic_results.write(tmp_path / "run", 1, 1, 1)
    commands = [
        ["report", "nowhere", "--factor", "10"], ["replay", "run", "68bf42c63dd7"],
        ["validate", "nowhere"], ["list", "problems"],
        ["run", "demo.toml", "--time-limit", "60"], ["report", "run", "--format", "md"],
        ["solve", "beam-ring/Nr=4/dual", "--solver", "osqp", "--tol", "2"],
        ["export", "beam-ring/dual", "a.txt"], ["run", "nowhere", "--case", "*"],
    ]  # fmt: skip
    chance, registries = random.Random(count), Registries()
    for _ in range(count // 3):
        argv = [*chance.choice(commands)]
        at = chance.randrange(1, len(argv))
        argv[at] = damaged_texts.damaged(argv[at], chance).replace("\x00", "")
        if argv in commands or "\n" in argv[at] or "-h" in argv[at]:
            continue
        with bounded():
            assert main(registries, argv) == 2, argv
        message = capsys.readouterr().err
        assert message.count("\n") == 1, argv
        assert len(message) < 1500
