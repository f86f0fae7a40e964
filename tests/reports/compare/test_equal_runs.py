"""False alarms in twenty pairs of real runs of one suite: at most one is allowed."""

import pytest

import mortarbench as mb

SUITE = """
name = "equal"
repeats = 3
solvers = ["smalbe", "clarabel", "piqp"]
[[problems]]
family = "beam-ring"
forms = ["dual"]
params = { Nr = [4, 6, 8], Nh = [3, 4, 5], steps = 1 }
zip = [["Nr", "Nh"]]
[[problems]]
family = "contact-patch"
forms = ["dual"]
params = { lower = [5, 7], upper = [3, 5] }
zip = [["lower", "upper"]]
"""


@pytest.mark.slow  # forty runs, ten minutes
def test_at_most_one_of_twenty_pairs_of_equal_runs_is_slower(tmp_path):
    (tmp_path / "equal.toml").write_text(SUITE)
    for number in range(40):
        mb.run(tmp_path / "equal.toml", out=tmp_path / f"{number}")
    failed = [
        mb.report(
            tmp_path / f"{n}", tmp_path / f"{n + 1}", formats=["csv"],
            fail_on=["slower"],
        ).failed_on
        for n in range(0, 40, 2)
    ]  # fmt: skip
    assert sum(map(bool, failed)) <= 1
