"""A result folder: held by one run at a time, of one suite in one environment."""

from __future__ import annotations

import fcntl
import json
import os
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from harness.errors import InputError
from harness.suite import Suite

#: all that a run writes, which `fresh` deletes and nothing else
_FOLDERS = ("journal", "vectors", "report")
_FILES = ("environment.json", "suite.toml")


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Keep every other run off a result folder, which is made if need be.

    Raises
    ------
    InputError
        When another run holds it, or it cannot be written.

    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        fd = os.open(folder / ".lock", os.O_RDWR | os.O_CREAT, 0o666)
    except OSError as e:
        raise InputError(
            f"{folder}: {e.strerror}; expected a folder that can be written"
        ) from None
    try:
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise InputError(
                f"{folder} is being written by another run; wait, or choose another"
            ) from None
        yield
    finally:
        os.close(fd)  # which unlocks


def claim(
    out: Path, suite: Suite, environment: Mapping[str, Any], *, fresh: bool
) -> None:
    """Make a locked folder that of this suite in this environment, or refuse to mix.

    environment : with its digest under the key ``digest``
    fresh : forget first what the folder holds

    Raises
    ------
    InputError
        When the folder holds another suite or another environment.

    """
    if fresh:
        for name in _FOLDERS:
            shutil.rmtree(out / name, ignore_errors=True)
        for name in _FILES:
            (out / name).unlink(missing_ok=True)
    remedy = "choose another --out or use --fresh"
    suite_file, environment_file = out / "suite.toml", out / "environment.json"
    if suite_file.exists() and suite_file.read_text("utf-8") != suite.text:
        raise InputError(
            f"{out} holds another suite ({suite_file} is not {suite.name!r} as it is "
            f"now); {remedy}"
        )
    if environment_file.exists():
        then, now = _digest_in(environment_file), environment["digest"]
        if then != now:
            raise InputError(
                f"{out} was measured in another environment ({then}, now {now}); "
                f"{remedy}"
            )
    _replace_text(suite_file, suite.text)
    _replace_text(environment_file, json.dumps(environment, indent=1) + "\n")


def _digest_in(path: Path) -> str:
    try:
        return str(json.loads(path.read_text("utf-8"))["digest"])
    except (ValueError, KeyError, TypeError):
        raise InputError(f"{path}: no JSON object with a digest") from None


def _replace_text(path: Path, text: str) -> None:
    """Write a file whole or not at all."""
    temporary = path.with_suffix(".tmp")
    temporary.write_text(text, "utf-8")
    os.replace(temporary, path)
