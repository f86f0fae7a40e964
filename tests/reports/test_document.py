"""Tables as LaTeX and CSV, and files of measurements."""

import shutil
import subprocess

import numpy as np
import pandas as pd
import pytest

from mortarbench.harness.results.journal import Journal
from mortarbench.reports.document import Table, latex, number, seconds
from mortarbench.reports.folder import write_report
from mortarbench.reports.measurements import read_measurements
from mortarbench.reports.sections import compose
from tests.support.box_records import box_record
from tests.support.measured import timed

WIDTH = 12.0  #: width of an article's column, cm


@pytest.fixture
def folder(tmp_path, rng):
    with Journal(tmp_path, "here") as journal:
        for k, solver in enumerate(("smalbe", "osqp", "clarabel", "proxqp")):
            for record in timed(rng, solver, 6, 7, 10.0 ** (k - 3)):
                n = record.params["n"] + 1
                journal.append(record.replace(
                    sizes={"variables": 50 * n}, environment="e",
                    total_seconds=record.total_seconds * n**1.5, energy_bound=1e-9 * n,
                ))  # fmt: skip
    return tmp_path


@pytest.mark.slow
@pytest.mark.skipif(
    shutil.which("pdflatex") is None, reason="no pdflatex (texlive-latex-base)"
)
@pytest.mark.parametrize("intervals", [True, False])
def test_tables_fit_into_the_column_of_an_article(folder, tmp_path, intervals):
    """Each table is set in a box, whose width LaTeX writes to the log."""
    document = compose(read_measurements(folder))
    names = ("answer", "times", "scaling", "iterations", "accuracy")
    shown = [t for s in document.sections if s.name in names for t in s.tables]
    assert {"answer", "times-dual", "exponents"} <= {t.name for t in shown}
    tables = latex(shown, intervals=intervals)
    boxed = tables.replace(r"\begin{tabular}", r"\sbox0{\begin{tabular}").replace(
        r"\end{tabular}", r"\end{tabular}}\typeout{WIDTH \the\wd0}\usebox0"
    )
    source = "\n".join([
        r"\documentclass{article}",
        r"\begin{document}", boxed, r"\end{document}",
    ])  # fmt: skip
    (tmp_path / "t.tex").write_text(source)
    done = subprocess.run(
        ["pdflatex", "-interaction=nonstopmode", "-halt-on-error", "t.tex"],
        cwd=tmp_path, capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout[-2000:]
    widths = [
        float(line.split()[1].removesuffix("pt")) * 2.54 / 72.27
        for line in done.stdout.splitlines()
        if line.startswith("WIDTH")
    ]
    assert len(widths) == len(shown)
    assert max(widths) <= WIDTH, dict(zip([t.name for t in shown], widths, strict=True))


def test_columns_without_content_are_left_out_and_texts_stay():
    table = Table(
        name="t", head=("solver", "time", "p"), caption="",
        rows=(("", "1 s", "–"), ("b", "2 s", "")),
    )  # fmt: skip
    assert table.compact().head == ("solver", "time")
    assert table.compact().rows == (("", "1 s"), ("b", "2 s"))


@pytest.mark.parametrize(
    ("value", "text"),
    [(0.012345, "12.3 ms"), (2.0, "2.00 s"), (9.996e-4, "1000 µs"), (None, "–"),
     (np.nan, "–"), (1e-9, "0.00100 µs")],
)  # fmt: skip
def test_times_have_three_digits_and_a_unit(value, text):
    assert seconds(value) == text


def test_numbers_keep_their_value_to_the_digits_shown():
    for value in (1234.6, 0.00123456, -5.5e-9, 7e12, 0.1):
        assert float(number(value, 3)) == pytest.approx(value, rel=5e-3)


def test_csv_and_parquet_contain_sizes_and_keys_for_pandas(folder):
    write_report(folder, ["csv", "parquet"])
    frames = (
        pd.read_csv(folder / "report/tables/measurements.csv"),
        pd.read_parquet(folder / "report/records.parquet"),
    )
    for df in frames:
        assert len(df) == 4 * 6 * 7
        assert (df.n == 100 * (df.key_n + 1)).all()
        assert (df.m == 50 * (df.key_n + 1)).all()
        medians = df.groupby(["solver", "m"]).total_seconds.median().unstack()
        slopes = np.polyfit(np.log(medians.columns), np.log(medians.T), 1)[0]
        assert slopes == pytest.approx([1.5] * 4, abs=0.05)
    pd.testing.assert_series_equal(*(df.total_seconds for df in frames))


def test_a_report_states_cases_whose_qps_differ_apart(tmp_path):
    with Journal(tmp_path, "here") as journal:
        for k, digest in enumerate(("aaaaaaaa", "bbbbbbbb")):
            journal.append(box_record("smalbe", 1, 0.01, k, qp=digest))
    answers = read_measurements(tmp_path).answers
    assert {*answers.case} == {"box/n=1/dual", "box/n=1/QP=bbbbbb/dual"}
    assert [*answers.repeats] == [1, 1]
