"""Measurements use the fastest CPU of a hybrid processor."""

import pytest

from mortarbench.harness.environment import cpus


@pytest.mark.parametrize(
    ("khz", "order"),
    [
        # four fast CPUs, then two slow ones, as on hybrid processors
        ({0: 5400, 1: 5400, 2: 5600, 3: 5600, 4: 4000, 5: 4000}, [3, 2, 1, 0, 5, 4]),
        ({0: 3000, 1: 3000, 2: 3000}, [2, 1, 0]),
        ({0: None, 1: None}, [1, 0]),  # virtual machines state no frequency
        ({0: None, 1: "many", 2: 10}, [2, 1, 0]),
    ],
)
def test_the_cpu_with_the_highest_frequency_comes_first(
    tmp_path, monkeypatch, khz, order
):
    for cpu, value in khz.items():
        if value is not None:
            folder = tmp_path / f"cpu{cpu}/cpufreq"
            folder.mkdir(parents=True)
            (folder / "cpuinfo_max_freq").write_text(f"{value}\n")
    monkeypatch.setattr(cpus, "_CPU", tmp_path)
    cpus._max_frequency.cache_clear()
    try:
        assert cpus.fastest_first(khz) == order
        assert cpus.fastest_first({0, 1}) == [c for c in order if c in (0, 1)]
    finally:
        cpus._max_frequency.cache_clear()
