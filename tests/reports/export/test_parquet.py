"""records.parquet contains the journal: one row per line, one type per field."""

import json

import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from mortarbench.harness import Record, Verdict
from mortarbench.harness.results.journal import Journal
from mortarbench.reports import write_report

NESTED = {"params", "sizes", "options", "counts", "reported", "quantities"}


def record(repeat=0, **changes):
    defaults = dict(
        run_id=f"r{repeat}", case="box/dual", family="box", params={"Nr": 4},
        form="dual", sizes={"variables": 3}, solver="a", options={"e": 1.0}, tol=1e-6,
        repeat=repeat, block=repeat, status=Verdict.VERIFIED, claimed="solved",
        iterations=7, total_seconds=0.25, quantities={"tip": [0.1, -0.2], "σ": 1.5},
    )  # fmt: skip
    return Record(**(defaults | changes))


@pytest.fixture
def folder(tmp_path):
    def write(name, *records):
        out = tmp_path / name
        out.mkdir()
        with Journal(out, "test") as journal:
            for one in records:
                journal.append(one)
        return out

    return write


def read(out):
    (path,) = write_report(out, ["parquet"])
    return path, pd.read_parquet(path)


def test_every_line_is_a_row_and_every_field_a_column(folder):
    records = [record(1), record(0, mode="sequence"), record(2, iterations=None)]
    path, frame = read(folder("a", *records))

    assert path.name == "records.parquet"
    assert list(frame.columns) == list(Record.__struct_fields__)
    assert list(frame.run_id) == ["r1", "r0", "r2"]  # in the order of the journal
    assert list(frame.solver) == ["a"] * 3  # the label of the journal, not of pages
    assert frame.total_seconds.sum() == 0.75
    assert frame.iterations[0] == 7
    assert pd.isna(frame.iterations[2])


def test_nested_values_are_json(folder):
    _, frame = read(folder("a", record()))

    assert json.loads(frame.quantities[0]) == {"tip": [0.1, -0.2], "σ": 1.5}
    for name in NESTED:
        assert isinstance(json.loads(frame[name][0]), dict)


def test_column_types_do_not_depend_on_the_values(folder):
    """Columns of missing values or of integers have the type of their field."""
    nothing = record(iterations=None, total_seconds=None, claimed=None)
    one = pq.read_schema(read(folder("a", record(tol=1)))[0])
    two = pq.read_schema(read(folder("b", nothing))[0])

    assert one == two
    assert one.field("iterations").type == pa.int64()
    assert one.field("tol").type == one.field("energy_bound").type == pa.float64()
    assert one.field("status").type == one.field("params").type == pa.string()
    assert one.field("remembered").type == pa.bool_()


def test_the_same_journal_gives_the_same_bytes(folder):
    records = [record(i) for i in range(3)]
    one, two = (read(folder(name, *records))[0].read_bytes() for name in "ab")
    again = write_report(folder("c", *records), ["parquet", "parquet"])[0].read_bytes()

    assert one == two == again
