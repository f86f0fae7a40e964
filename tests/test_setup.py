"""`make setup`: announcement and confirmation of installations, paths with spaces."""

import os
import pty
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path
from urllib.parse import unquote, urlparse

import pytest

from tests.support import ROOT

#: replacements for system programs; apt-get and sudo append their commands to `calls`
STUBS = {
    "dpkg-query": "exit 1",
    "apt-get": 'echo "apt-get $*" >> "$CALLS"; exit 1',
    "sudo": 'echo "sudo $*" >> "$CALLS"; [ -z "$REFUSED" ] || exit 1; '
    '[ "$1" != -n ] || shift; exec "$@"',
    "id": "echo 1000",
}
#: replacement for the environment's Python, which records the constraints given to pip
PYTHON = """#!/bin/sh
case "$*" in
    *install*) printf '%s\\n' "$PIP_CONSTRAINT" "$PIP_BUILD_CONSTRAINT" > "$CALLS" ;;
    -c*) exec {python} "$@" ;;
esac
"""


@pytest.fixture
def folder(tmp_path):
    """Return a checkout in a path with a space, on a system without the packages."""
    folder = tmp_path / "a b"
    (folder / "tools").mkdir(parents=True)
    shutil.copy(ROOT / "tools" / "setup.sh", folder / "tools")
    for name, text in STUBS.items():
        program(tmp_path / "bin" / name, f"#!/bin/sh\n{text}\n")
    return folder


def program(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)
    path.chmod(0o755)


def setup(folder, answer=None, **env):
    """Run setup.sh; return its exit code, output and calls of system programs.

    answer : text typed on a terminal; None for a run without a terminal
    """
    calls, bin_ = folder.parent / "calls", folder.parent / "bin"
    env = {"PATH": f"{bin_}:{os.environ['PATH']}", "CALLS": str(calls), **env}
    command = [folder / "tools" / "setup.sh", sys.executable]
    if answer is None:
        done = subprocess.run(
            command, env=os.environ | env, stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        )  # fmt: skip
        code, said = done.returncode, done.stdout
    else:
        ours, theirs = pty.openpty()
        os.write(ours, f"{answer}\n".encode())
        code = subprocess.run(
            command, env=os.environ | env, stdin=theirs, stdout=theirs, stderr=theirs
        ).returncode
        os.close(theirs)
        said = b"".join(iter(partial(chunk, ours), b"")).decode()
        os.close(ours)
    return code, said, calls.read_text() if calls.exists() else ""


def chunk(terminal):
    """Read the next output of a terminal; return b"" at the end."""
    try:
        return os.read(terminal, 2**16)
    except OSError:  # raised by Linux if the other end is closed
        return b""


@pytest.mark.parametrize("answer", ["n", "", "what?"])
def test_on_a_terminal_nothing_is_installed_without_confirmation(folder, answer):
    code, said, calls = setup(folder, answer)

    assert code == 1
    assert "missing system packages: libsuitesparse-dev" in said
    assert "run sudo apt-get install" in said
    assert "nothing was installed" in said
    assert calls == ""


def test_on_a_terminal_a_yes_installs(folder):
    _, _, calls = setup(folder, "y")
    assert calls.startswith("sudo apt-get update")
    assert "apt-get install -y --no-install-recommends libsuitesparse-dev" in calls


def test_without_a_terminal_sudo_must_not_ask_for_a_password(folder):
    code, said, calls = setup(folder, REFUSED="1")
    assert code == 1
    assert "run: sudo apt-get install" in said
    assert calls == "sudo -n true\n"


def test_without_a_terminal_the_packages_are_announced_before_installation(folder):
    _, said, calls = setup(folder)
    assert said.startswith("setup: missing system packages: libsuitesparse-dev")
    assert "apt-get install -y" in calls


def test_constraints_given_to_pip_contain_no_space(folder):
    program(folder.parent / "bin" / "dpkg-query", "#!/bin/sh\necho ' installed'\n")
    program(folder / ".venv/bin/python", PYTHON.format(python=sys.executable))
    (folder / "constraints.txt").touch()

    code, said, calls = setup(folder)

    assert code == 0, said
    for constraint in calls.splitlines():
        assert not set(constraint) & set(" \t")
        assert Path(unquote(urlparse(constraint).path)).samefile(
            folder / "constraints.txt"
        )
    assert len(calls.splitlines()) == 2
