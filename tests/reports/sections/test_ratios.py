"""Section on the ratios of times within blocks."""

from pathlib import Path

import pytest

from mortarbench.reports.data.evidence import Evidence, arrange
from mortarbench.reports.folder import compose
from mortarbench.reports.render.markdown import markdown
from tests.support.box_records import box_record


@pytest.mark.parametrize(("common", "unpaired"), [(2, False), (1, True), (0, True)])
def test_an_unpaired_ratio_is_explained(common, unpaired):
    records = [
        box_record(solver, 0, seconds, k).replace(
            session="late" if solver == "b" and k >= common else "early",
            run_id=f"{solver}{k}",
        )
        for solver, seconds in (("a", 1.0), ("b", 2.0))
        for k in range(3)
    ]
    said = markdown(compose(Evidence(directory=Path(), records=arrange(records))))
    assert ("unpaired" in said) is unpaired
    assert ("Unpaired: the two solvers" in said) is unpaired
