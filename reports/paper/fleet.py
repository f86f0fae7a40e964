"""SMALBE and other solvers: dual and primal forms, and time to certified accuracy."""

from __future__ import annotations

from collections.abc import Sequence

from matplotlib.figure import Figure

from mortarbench.reports.answer import rows, sentence, table, with_errors
from mortarbench.reports.document import Item, Picture, Section, Table
from mortarbench.reports.figures.curves import accuracy, against
from mortarbench.reports.measurements import Measurements
from mortarbench.reports.sections import routes
from mortarbench.reports.sections.solvers import tightest, times

TARGETS = (1e-2, 1e-4, 1e-6)  #: certified relative errors in the energy norm
_TIMED = "Median time of preparation and solve of verified answers"
_REPEATED = (
    "Repeats are interleaved, in random order, in separate worker processes. Every "
    "answer is verified on the original QP; only verified answers have times."
)


def fleet(run: Measurements, solvers: Sequence[str]) -> tuple[Section, ...]:
    """Return the sections on times against m, and on primal against dual forms."""
    answers = tightest(run.answers)
    solved = answers[answers.verified & (answers.total_seconds > 0)]
    time = solved.total_seconds + solved.dualise_seconds.fillna(0)
    charged = solved.assign(total_seconds=time)[solved.form.isin(["primal", "dual"])]
    by_m = _picture(
        "fleet",
        f"{_TIMED} against the size m of the dual, at the last load step. The form "
        "dual-bounds has no equalities.",
        against(solved[solved.form != "primal"], solvers),
    )
    by_n = _picture(
        "totals",
        f"{_TIMED} against n. The dual form includes dualisation and factorisation for "
        "one load step. SMALBE declines the primal form.",
        against(charged, solvers, "n"),
    )
    tables = [t for t in times(run, []) if isinstance(t, Table)]
    ways = [i for i in routes.mesh(run, []) if not isinstance(i, Picture)]
    return (
        Section(
            name="fleet",
            title="Beyond the paper: SMALBE and other solvers",
            items=(_REPEATED, *by_m, *tables),
        ),
        Section(
            name="totals",
            title="Beyond the paper: primal against dual",
            items=(*ways, *by_n),
        ),
    )


def certified(run: Measurements, solvers: Sequence[str]) -> tuple[Section, ...]:
    """Return the section on time to certified accuracy."""
    found = [row for row in rows(run) if row.accuracy in TARGETS]
    answers = with_errors(run.answers)
    picture = _picture(
        "certified",
        "Certified relative error of the displacement in the energy norm against the "
        f"median time at n = {answers.n.max():.0f}, one curve over the requested "
        "tolerances for each solver. The certificate is an upper bound computed from "
        "the answer alone.",
        accuracy(answers, solvers),
    )
    title = "Beyond the paper: time to certified accuracy"
    items: list[Item] = [*map(sentence, found), table(found, run.solvers), *picture]
    return (Section(name="certified", title=title, items=tuple(items)),)


def _picture(name: str, caption: str, figure: Figure | None) -> list[Picture]:
    """Return a picture of a figure; none if there is nothing to draw."""
    return [Picture(name=name, caption=caption, draw=lambda: figure)] if figure else []
