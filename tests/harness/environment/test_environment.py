"""Environments contain values that affect times, but no data about the user."""

import copy
import json
import os
import platform
import re
import socket
import subprocess
import tomllib
from hashlib import sha256
from pathlib import Path

import pytest

from mortarbench.harness.environment.doctor import advice, render
from mortarbench.harness.environment.environment import (
    capture,
    digest,
    source,
)
from tests.support import ROOT


@pytest.fixture
def quiet():
    """Return an environment without any warning."""
    return {
        "machine": {
            "cpu": "Some CPU", "usable_cores": 8, "cpu_limit": None,
            "memory_mib": 16000, "system": "Linux", "kernel": "6.1",
            "governor": "performance", "turbo": False, "smt": False,
        },
        "versions": {"python": "3.11.2", "scikit-sparse": "0.4.16"},
        "source": {"commit": "0123456789abcdef", "dirty": False},
        "threads": {"OMP_NUM_THREADS": "1"},
        "blas": {"libopenblas (numpy)": "0.3.21 pthreads Haswell"},
        "now": {"time": "2026-01-01", "load": 0.1},
    }  # fmt: skip


def changed(environment, path, value):
    """Return a copy with the entry at a dotted path replaced."""
    result = copy.deepcopy(environment)
    *parents, last = path.split(".")
    entry = result
    for key in parents:
        entry = entry[key]
    entry[last] = value
    return result


@pytest.mark.parametrize("path", ["now.load", "now.time"])
def test_the_digest_ignores_load_and_time(quiet, path):
    assert digest(changed(quiet, path, 7)) == digest(quiet)


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("versions.scikit-sparse", "0.4.15"),
        ("blas", {"libblas (system)": "3.11"}),
        ("threads", {"OMP_NUM_THREADS": "2"}),
        ("machine.cpu", "Another CPU"),
        ("source.dirty", True),
    ],
)
def test_the_digest_changes_with_values_that_affect_times(quiet, path, value):
    assert digest(changed(quiet, path, value)) != digest(quiet)


def test_the_digest_has_12_hex_digits_and_ignores_the_order_of_keys(quiet):
    reordered = dict(reversed(quiet.items()))
    assert digest(reordered) == digest(quiet)
    assert re.fullmatch(r"[0-9a-f]{12}", digest(quiet))


def test_consecutive_captures_have_equal_digests_also_after_json():
    first, second = capture(), json.loads(json.dumps(capture()))
    assert digest(first) == digest(second)


def test_a_capture_contains_no_host_name_and_no_absolute_path(monkeypatch):
    host = "a-planted-host-name"
    planted = os.uname_result(("Linux", host, "6.1.0", "#1 SMP", "x86_64"))
    monkeypatch.setattr(os, "uname", lambda: planted)
    monkeypatch.setattr(platform, "_uname_cache", None, raising=False)
    monkeypatch.setattr(socket, "gethostname", lambda: host)
    text = json.dumps(capture())
    assert host not in text
    assert not re.search(r'"/|\s/\w|\w/\w+/', text)
    assert str(Path.home()) not in text


def test_plugins_are_recorded_by_name_and_digest_of_their_content(tmp_path):
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
    assert both["plugins"] == plain["plugins"]  # an empty namesake changes no digest
    assert changed_one["plugins"] != plain["plugins"]
    assert capture([file, namesake])["plugins"] != changed_one["plugins"]
    assert digest(changed_one) != digest(plain)
    assert capture()["plugins"] == {}


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """Create a repository with one commit."""
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
def test_two_states_of_a_dirty_checkout_have_different_digests(checkout, name):
    states = []
    for text in ("x = 2\n", "x = 3\n", "x = 2\n"):
        (checkout / "harness" / name).write_text(text)
        states.append(source(checkout))

    assert all(state["dirty"] for state in states)
    assert states[0] == states[2] != states[1]
    assert re.fullmatch("[0-9a-f]{12}", states[0]["changes"])


def test_a_quiet_machine_gets_no_advice(quiet):
    assert advice(quiet) == {}
    assert "Fit for measuring" in str(render(quiet, "0123456789ab"))


@pytest.mark.parametrize(
    ("path", "value", "remedy"),
    [
        ("machine.governor", "powersave", "cpupower frequency-set -g performance"),
        ("machine.governor", "performance, powersave", "cpupower frequency-set"),
        ("machine.turbo", True, "echo 0 | sudo tee"),
        ("machine.smt", True, "echo off | sudo tee"),
        ("machine.cpu_limit", 0.5, "docker run --cpus=2"),
        ("machine.usable_cores", 1, "2 cores"),
        ("now.load", 0.6, "stop other programs"),
    ],
)
def test_each_problem_comes_with_advice(quiet, path, value, remedy):
    ((key, text),) = advice(changed(quiet, path, value)).items()

    assert key.startswith(path)
    assert remedy in text
    assert "\n" not in text


def test_values_that_cannot_be_read_are_not_criticised(quiet):
    for path in ("machine.governor", "machine.turbo", "machine.smt", "source"):
        quiet = changed(quiet, path, None)

    assert advice(quiet) == {}
    assert "machine.turbo" in str(render(quiet, "0123456789ab"))


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
        *project["project"]["optional-dependencies"]["browser"],
        *project["project"]["optional-dependencies"]["docs"],
        *project["build-system"]["requires"],
    ]
    wanted = {normal(re.match(r"[\w.-]+", requirement)[0]) for requirement in named}
    assert wanted <= {normal(pin.partition("==")[0]) for pin in read_pins()}


def test_constraints_are_sorted_exact_pins_without_urls():
    pins = read_pins()
    for pin in pins:
        assert re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.!+]+", pin), pin
    assert pins == sorted(pins, key=str.lower)
    assert "mortarbench" not in {pin.partition("==")[0] for pin in pins}
