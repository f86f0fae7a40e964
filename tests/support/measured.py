"""Measurements with planted times, for tests of reports."""

from pathlib import Path

from mortarbench.harness.results.frame import frame_of
from mortarbench.reports.measurements import Measurements, derived
from tests.support.box_records import box_record


def measurements(records, folder="run", **more):
    """Return the measurements of records, as if they had been read from a folder."""
    return Measurements(folder=Path(folder), df=derived(frame_of(records)), **more)


def timed(
    rng, solver, cases, repeats, seconds=0.01, noise=0.02, scatter=0.0, **changes
):
    """Return records of one solver with log-normal times around `seconds`.

    noise, scatter : standard deviations of the logarithm within and between cases
    """
    return [
        box_record(
            solver, case, float(middle * rng.lognormal(0, noise)), repeat, **changes
        )
        for case, middle in enumerate(seconds * rng.lognormal(0, scatter, cases))
        for repeat in range(repeats)
    ]
