"""Effects of `make setup` on a system: announced, confirmed, in any folder."""

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

#: stand for programs of the system; each writes its command into the file `calls`
STUBS = {
    "dpkg-query": "exit 1",
    "apt-get": 'echo "apt-get $*" >> "$CALLS"; exit 1',
    "sudo": 'echo "sudo $*" >> "$CALLS"; [ -z "$REFUSED" ] || exit 1; '
    '[ "$1" != -n ] || shift; exec "$@"',
    "id": "echo 1000",
}
#: stands for the Python of the environment: says what pip is told
PYTHON = """#!/bin/sh
case "$*" in
    *install*) printf '%s\\n' "$PIP_CONSTRAINT" "$PIP_BUILD_CONSTRAINT" > "$CALLS" ;;
    -c*) exec {python} "$@" ;;
esac
"""


@pytest.fixture
def folder(tmp_path):
    """A checkout in a path with a space, on a system that lacks all packages."""
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
    """Run it, on a terminal if there is an answer: code, what it said and called."""
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
    """Read what is left of a terminal's output; nothing once all of it is read."""
    try:
        return os.read(terminal, 2**16)
    except OSError:  # Linux says so where the other end is closed
        return b""


@pytest.mark.parametrize("answer", ["n", "", "what?"])
def test_on_a_terminal_nothing_is_installed_without_a_yes(folder, answer):
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


def test_without_a_terminal_sudo_may_ask_for_nothing(folder):
    code, said, calls = setup(folder, REFUSED="1")
    assert code == 1
    assert "run: sudo apt-get install" in said
    assert calls == "sudo -n true\n"


def test_without_a_terminal_what_will_be_installed_is_said_first(folder):
    _, said, calls = setup(folder)
    assert said.startswith("setup: missing system packages: libsuitesparse-dev")
    assert "apt-get install -y" in calls


def test_pip_is_given_constraints_that_no_space_splits(folder):
    program(folder.parent / "bin" / "dpkg-query", "#!/bin/sh\necho ' installed'\n")
    program(folder / ".venv/bin/python", PYTHON.format(python=sys.executable))
    (folder / "constraints.txt").touch()

    code, said, calls = setup(folder)

    assert code == 0, said
    for told in calls.splitlines():
        assert not set(told) & set(" \t")
        assert Path(unquote(urlparse(told).path)).samefile(folder / "constraints.txt")
    assert len(calls.splitlines()) == 2
