"""A suite with a result folder may only add measurements."""

import pytest

from mortarbench.harness.errors import InputError
from mortarbench.harness.suite.growth import incompatibility, unite
from mortarbench.harness.suite.suite import suite_file

SUITE = {
    "name": "s", "tolerances": [1e-6, 1e-8], "repeats": 3, "time_limit": 60,
    "solvers": ["a", {"name": "b", "label": "b-50", "options": {"max_iter": 50}}],
}  # fmt: skip


@pytest.mark.parametrize(
    "more",
    [
        {},
        {"time_limit": 60.0, "memory_limit": 4096},  # equal to the defaults
        {"solvers": [*SUITE["solvers"], "c"]},
        {"solvers": SUITE["solvers"][::-1]},
        {"tolerances": [1e-4, 1e-6, 1e-8]},
        {"repeats": 5},
        {"null_arm": "a"},
    ],
)
def test_an_extended_suite_counts_as_the_same_suite(more):
    assert incompatibility(suite_file(SUITE), suite_file(SUITE | more)) == ""


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"name": "t"}, "name was 's', now 't'"),
        ({"time_limit": 5}, "time_limit was 60, now 5"),
        ({"repeats": 2}, "repeats was 3, now 2; it may only grow"),
        ({"tolerances": [1e-8]}, "tolerance 1e-06 is missing; tolerances may be added"),
        ({"solvers": ["a"]}, "solver 'b-50' is missing; solvers may be added"),
        (
            {"solvers": ["a", {"name": "c", "label": "b-50"}]},
            "solver 'b-50' was 'b', now 'c'",
        ),
    ],
)
def test_settings_of_past_measurements_may_not_change(change, said):
    assert incompatibility(suite_file(SUITE), suite_file(SUITE | change)) == said


def test_a_null_arm_may_not_be_removed():
    with_copy, without = suite_file(SUITE | {"null_arm": "a"}), suite_file(SUITE)
    assert incompatibility(with_copy, without) == "null_arm was 'a', now not set"


def test_a_conflict_of_labels_names_the_two_folders_in_conflict():
    """The folder without the label is not blamed, although it comes first."""
    tables = {
        "a": {"solvers": ["piqp"]},
        "b": {"solvers": [{"name": "osqp", "label": "mine"}]},
        "c": {"solvers": [{"name": "clarabel", "label": "mine"}]},
    }
    with pytest.raises(InputError, match=r"'osqp'} in b, .*'clarabel'} in c;"):
        unite({k: suite_file({"name": "s", **v}) for k, v in tables.items()})
