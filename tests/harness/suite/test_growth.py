"""A suite with a result folder may only add measurements."""

import pytest

from mortarbench.harness.errors import InputError
from mortarbench.harness.suite.growth import refuse_changed
from mortarbench.harness.suite.suite import suite_file

SUITE = {
    "name": "s", "tolerances": [1e-6, 1e-8], "repeats": 3, "time_limit": 60,
    "solvers": ["a", {"name": "b", "label": "b-50", "options": {"max_iter": 50}}],
    "problems": [{"family": "f", "params": {"step": [1, 2]}, "sequence": "step"}],
}  # fmt: skip


@pytest.mark.parametrize(
    "more",
    [
        {"time_limit": 60.0, "memory_limit": 4096},  # equal to the defaults
        {"solvers": [*SUITE["solvers"][::-1], "c"]},
        {"tolerances": [1e-4, 1e-6, 1e-8], "repeats": 5, "null_arm": "a"},
        {"problems": [*SUITE["problems"], {"family": "g"}]},
    ],
)
def test_a_suite_may_be_extended(more):
    refuse_changed(suite_file(SUITE), suite_file(SUITE | more), "here")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"name": "t"}, "name is 's' in here, 't' in the suite"),
        ({"time_limit": 5}, "time_limit is 60 in here, 5 in the suite"),
        ({"accuracy": 1e-8}, "accuracy is None in here, 1e-08 in the suite"),
        (
            {"problems": [SUITE["problems"][0] | {"params": {"step": [1, 3]}}]},
            "here has a sequence of f along step that the suite lacks",
        ),
    ],
)
def test_settings_of_past_measurements_may_not_change(change, said):
    with pytest.raises(InputError, match=said):
        refuse_changed(suite_file(SUITE), suite_file(SUITE | change), "here")
