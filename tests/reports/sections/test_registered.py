"""Registration of sections with positions and required measurements."""

import pytest

from mortarbench.harness import Record, Verdict
from mortarbench.reports import sections
from mortarbench.reports.data.evidence import Evidence, arrange
from mortarbench.reports.document.layout import Cell, Point, Statement, Table
from mortarbench.reports.sections import Analysis, section


@pytest.fixture
def analysis(monkeypatch, tmp_path):
    """Return an analysis; sections that a test registers are removed after the test."""
    monkeypatch.setattr(sections, "_ENTRIES", sections._entries())
    records = [
        Record(
            run_id=solver, case="box/n=1/dual", family="box", params={"n": 1},
            form="dual", sizes={"variables": 1}, solver=solver, options={}, tol=1e-8,
            repeat=0, block=0, status=Verdict.VERIFIED, claimed="solved",
            total_seconds=0.003, primal=0.0, dual=0.0, complementarity=0.0, gap=0.0,
            environment="e", started="2026-11-21T10:00:00+00:00",
        )
        for solver in ("one", "two")
    ]  # fmt: skip
    return Analysis(Evidence(directory=tmp_path, records=arrange(records)))


def test_a_section_has_a_position_and_sorts_its_parts_by_type(analysis):
    table = Table.of("T", [1, 2], [("n", Cell.number)])
    said = Statement(subject="x", claims=("yes",))

    @section(13, "extra", lambda a: f"{len(a.evidence.solvers)} solvers")
    def extra(_):
        yield from (Point("first"), table, "A paragraph.", Point("second"), said)

    found = list(sections.sections(analysis))
    names = [one.name for one in found]
    assert names[names.index("summary") :][:3] == ["summary", "extra", "cases"]
    made = found[names.index("extra")]
    assert made.title == "2 solvers"
    assert (made.prose, made.points) == (("A paragraph.",), ("first", "second"))
    assert (made.tables, made.statements, made.pictures) == ((table,), (said,), ())
    assert [row[0].value for row in table.rows] == [1, 2]


def test_a_section_without_parts_is_listed_with_its_requirements(analysis):
    @section(13, "extra", "Extra", "Extra: it needs a moon.")
    def extra(_):
        yield from ()

    names = {one.name: one for one in sections.sections(analysis)}
    assert "extra" not in names
    assert "Extra: it needs a moon." in names["absent"].points
    assert list(names)[-3:] == ["absent", "environment", "definitions"]


def test_names_and_places_of_sections_differ(analysis):
    entries = sections._entries()
    assert len({entry.place for entry in entries}) == len(entries) > 20
    names = [one.name for one in sections.sections(analysis)]
    assert len(set(names)) == len(names)
