"""The environment says what times depend on, and nothing about who measured."""

import copy
import json
import os
import platform
import re
import socket
import subprocess
import sys
import tomllib
from hashlib import sha256
from itertools import count
from pathlib import Path

import numpy as np
import pytest

from harness.doctor import advice, noise_floor, render
from harness.environment import capture, capture_in, digest, source, system_blas

ROOT = Path(__file__).resolve().parents[1]
DEBIAN = "/usr/lib/x86_64-linux-gnu"
WHEEL = "/opt/venv/lib/python3.11/site-packages/numpy.libs/libopenblas64_p-r0-1f.so"
ONE_THREAD = {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def pool(library="libopenblas", owner="system", threads=1):
    return {
        "library": library, "owner": owner, "version": "0.3.21",
        "architecture": "Haswell", "layer": "pthreads", "threads": threads,
    }  # fmt: skip


@pytest.fixture
def quiet():
    """An environment with nothing to complain about."""
    return {
        "machine": {
            "cpu": "Some CPU", "physical_cores": 4, "logical_cores": 8,
            "usable_cores": 8, "cpu_limit": None, "memory_mib": 16000,
            "architecture": "x86_64", "system": "Linux", "kernel": "6.1",
            "libc": "glibc 2.36", "governor": "performance", "turbo": False,
        },
        "versions": {"python": "3.11.2", "scikit-sparse": "0.4.16"},
        "source": {"commit": "0123456789abcdef", "dirty": False},
        "threads": {"variables": {"OMP_NUM_THREADS": "1"}, "pools": [pool()]},
        "cholmod": {"version": "3.0.14", "blas": "OpenBLAS 0.3.21 (pthreads)"},
        "now": {"time": "2026-01-01", "load": 0.1, "available_memory_mib": 9000},
    }  # fmt: skip


def changed(environment, path, value):
    """Copy with the entry at the dotted path replaced."""
    result = copy.deepcopy(environment)
    *parents, last = path.split(".")
    entry = result
    for key in parents:
        entry = entry[key]
    entry[last] = value
    return result


@pytest.mark.parametrize("path", ["now.load", "now.available_memory_mib", "now.time"])
def test_the_digest_ignores_what_changes_from_minute_to_minute(quiet, path):
    assert digest(changed(quiet, path, 7)) == digest(quiet)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("versions.scikit-sparse", "0.4.15"),
        ("cholmod.blas", "reference BLAS"),
        ("threads.variables", {"OMP_NUM_THREADS": "2"}),
        ("threads.pools", [pool(threads=2)]),
        ("machine.cpu", "Another CPU"),
        ("source.dirty", True),
    ],
)
def test_the_digest_changes_with_what_times_depend_on(quiet, path, value):
    assert digest(changed(quiet, path, value)) != digest(quiet)


def test_the_digest_is_12_hex_digits_whatever_the_order_of_keys(quiet):
    reordered = dict(reversed(quiet.items()))
    assert digest(reordered) == digest(quiet)
    assert re.fullmatch(r"[0-9a-f]{12}", digest(quiet))


def test_two_captures_in_a_row_have_one_digest_through_json():
    first, second = capture(), json.loads(json.dumps(capture()))
    assert digest(first) == digest(second)


def test_a_capture_tells_no_host_name_and_no_absolute_path(monkeypatch):
    host = "a-planted-host-name"
    planted = os.uname_result(("Linux", host, "6.1.0", "#1 SMP", "x86_64"))
    monkeypatch.setattr(os, "uname", lambda: planted)
    monkeypatch.setattr(platform, "_uname_cache", None, raising=False)
    monkeypatch.setattr(socket, "gethostname", lambda: host)
    text = json.dumps(capture())
    assert host not in text
    assert not re.search(r'"/|\s/\w|\w/\w+/', text)
    assert str(Path.home()) not in text


def test_plugins_are_named_by_their_content(tmp_path):
    (tmp_path / "other").mkdir()
    file, namesake = tmp_path / "a.py", tmp_path / "other" / "a.py"
    file.write_text("x = 1")
    namesake.write_text("")

    plain = capture([file])
    both = capture([file, namesake])
    file.write_text("x = 2")
    changed_one = capture([file])
    namesake.write_text("y = 3")

    assert plain["plugins"] == {"a.py": sha256(b"x = 1").hexdigest()[:12]}
    assert both["plugins"] == plain["plugins"]  # nothing in it
    assert changed_one["plugins"] != plain["plugins"]
    assert capture([file, namesake])["plugins"] != changed_one["plugins"]
    assert digest(changed_one) != digest(plain)
    assert capture()["plugins"] == {}


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A repository with one commit."""
    for who in ("AUTHOR", "COMMITTER"):
        monkeypatch.setenv(f"GIT_{who}_NAME", "A")
        monkeypatch.setenv(f"GIT_{who}_EMAIL", "a@example.org")
    (tmp_path / "harness").mkdir()
    (tmp_path / "harness" / "a.py").write_text("x = 1\n")
    for arguments in (["init", "-q"], ["add", "."], ["commit", "-q", "-m", "First"]):
        subprocess.run(["git", "-C", str(tmp_path), *arguments], check=True)
    return tmp_path


def test_a_checkout_as_committed_is_clean(checkout):
    (checkout / "notes.py").write_text("elsewhere")

    assert source(checkout).keys() == {"commit", "dirty", "changes"}
    assert (source(checkout)["dirty"], source(checkout)["changes"]) == (False, None)


@pytest.mark.parametrize("name", ["a.py", "new file.py"])
def test_two_states_of_a_dirty_checkout_are_told_apart(checkout, name):
    states = []
    for text in ("x = 2\n", "x = 3\n", "x = 2\n"):
        (checkout / "harness" / name).write_text(text)
        states.append(source(checkout))

    assert all(state["dirty"] for state in states)
    assert states[0] == states[2] != states[1]
    assert re.fullmatch("[0-9a-f]{12}", states[0]["changes"])


def test_a_capture_holds_the_versions_that_the_modules_themselves_tell():
    versions = capture()["versions"]
    assert versions["numpy"] == np.__version__
    assert versions["python"] == ".".join(map(str, sys.version_info[:3]))
    assert None not in versions.values()


def test_thread_variables_take_effect_in_the_captured_process():
    captured = capture_in(ONE_THREAD)
    pools = captured["threads"]["pools"]
    assert captured["threads"]["variables"].items() >= ONE_THREAD.items()
    assert {"numpy", "scipy"} <= {p["owner"] for p in pools}
    assert {p["threads"] for p in pools} == {1}


@pytest.mark.parametrize(
    ("mapped", "name"),
    [
        ([f"{DEBIAN}/blas/libblas.so.3.11.0", WHEEL], "reference BLAS"),
        (
            [
                f"{DEBIAN}/openblas-pthread/libblas.so.3",
                f"{DEBIAN}/openblas-pthread/libopenblasp-r0.3.21.so",
                WHEEL,
            ],
            "OpenBLAS 0.3.21 (pthreads)",
        ),
        (["/opt/intel/lib/libmkl_rt.so.2"], "MKL"),
        ([WHEEL], None),
    ],
)
def test_cholmods_blas_is_the_one_outside_the_wheels_of_others(mapped, name):
    pools = [pool("libopenblas64_", "numpy") | {"version": "0.3.30"}]
    pools += [pool()] if name and name.startswith("OpenBLAS") else []
    assert system_blas(mapped, pools) == name


def test_a_quiet_machine_gets_no_advice(quiet):
    assert advice(quiet) == []


@pytest.mark.parametrize(
    ("path", "value", "remedy"),
    [
        ("cholmod.blas", "reference BLAS", "sudo apt-get install libopenblas0-pthread"),
        ("threads.pools", [pool(threads=2)], "export OMP_NUM_THREADS=1 OPENBLAS_NUM_"),
        ("machine.governor", "powersave", "cpupower frequency-set -g performance"),
        ("machine.cpu_limit", 0.5, "docker run --cpus=2"),
        ("now.load", 0.6, "stop them"),
        ("now.available_memory_mib", 500, "memory_limit"),
        ("versions.scikit-sparse", None, "make setup"),
    ],
)
def test_each_trouble_gets_one_sentence_with_its_remedy(quiet, path, value, remedy):
    (sentence,) = advice(changed(quiet, path, value))
    assert remedy in sentence
    assert "\n" not in sentence


def test_what_cannot_be_read_is_no_reason_to_complain(quiet):
    for path in ("machine.governor", "now.available_memory_mib", "machine.turbo"):
        quiet = changed(quiet, path, None)
    assert advice(quiet) == []


def test_the_rendered_values_stand_in_one_column_and_the_advice_below(quiet):
    table, _, below = render(quiet, ["Do this."]).partition("\n\n")
    rows = [re.match(r"(\S+(?: \S+)*)\s{2,}", line) for line in table.splitlines()]
    assert len({row.end() for row in rows}) == 1
    assert below == "- Do this."
    assert "OpenBLAS 0.3.21 (pthreads)" in table
    assert digest(quiet) in table


def test_a_perfect_clock_shows_no_noise_between_equal_arms():
    ticks = count()
    noise = noise_floor(500.0, clock=lambda: float(next(ticks)))
    assert (noise.ratio, noise.half_width) == (1.0, 0.0)
    assert (noise.kernel_seconds, noise.clock_seconds) == (1.0, 1.0)


def test_a_steady_drift_hits_both_arms_alike():
    readings = (0.5 * k**2 for k in count())  # every interval 1 longer than the last
    noise = noise_floor(200.0, clock=lambda: next(readings))
    assert noise.pairs == 4  # two times ABBA
    assert noise.ratio == pytest.approx(1.0, rel=1e-12)


@pytest.mark.parametrize("amplitude", [0.05, 0.5])
def test_the_interval_of_an_unsteady_clock_holds_the_true_ratio(amplitude):
    rng = np.random.default_rng(271828)
    readings = (k + amplitude * rng.random() for k in count())
    noise = noise_floor(1000.0, clock=lambda: next(readings))
    assert abs(noise.ratio - 1) < 2 * noise.half_width
    assert 0.01 * amplitude < noise.half_width < amplitude


def read_pins():
    lines = (ROOT / "constraints.txt").read_text().splitlines()
    return [line for line in lines if not line.startswith("#")]


def normal(name):
    return re.sub(r"[-_.]+", "-", name).lower()


def test_every_dependency_is_pinned():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())
    named = [
        *project["project"]["dependencies"],
        *project["project"]["optional-dependencies"]["dev"],
        *project["build-system"]["requires"],
    ]
    wanted = {normal(re.match(r"[\w.-]+", requirement)[0]) for requirement in named}
    assert wanted <= {normal(pin.partition("==")[0]) for pin in read_pins()}


def test_constraints_are_exact_pins_in_order_and_hold_no_address():
    pins = read_pins()
    for pin in pins:
        assert re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.!+]+", pin), pin
    assert pins == sorted(pins, key=str.lower)
    assert "mortarbench" not in {pin.partition("==")[0] for pin in pins}
