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

from harness.environment import VOLATILE
from harness.errors import InputError, some
from harness.reading import MOST_TOML, read_json, read_text, read_toml, toml
from harness.suite import Suite

#: all that a run writes, and what is made of it; `fresh` deletes that, nothing else
_FOLDERS = ("journal", "vectors", "cases", "environments", "references", "report")
_FILES = ("environment.json", "suite.toml")
_VERDICT = "validation.json"  #: of `mortarbench validate`


def refuse_foreign(folder: Path) -> None:
    """Refuse a folder where we would write over, or delete, what is not ours.

    Raises
    ------
    InputError
        When something there has a name that we use, but no run made it.

    """
    if all((folder / name).is_file() for name in _FILES):
        return
    if next((folder / "journal").glob("*.jsonl"), None) is not None:
        return
    ours = (*_FOLDERS, *_FILES, _VERDICT)
    taken = [name for name in ours if os.path.lexists(folder / name)]
    if taken:
        raise InputError(
            f"{folder} holds {some(taken)} but is no result folder (no suite.toml with "
            "environment.json, no journal/*.jsonl); choose another --out"
        )


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


@contextmanager
def scratch_in(folder: Path) -> Iterator[Path]:
    """Make room in a locked folder for files that only last as long as a run.

    What a killed run left there is deleted first.
    """
    scratch = folder / ".scratch"
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    try:
        yield scratch.resolve()
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


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
        for name in (*_FILES, _VERDICT):
            (out / name).unlink(missing_ok=True)
    remedy = "choose another --out or use --fresh"
    suite_file, environment_file = out / "suite.toml", out / "environment.json"
    if suite_file.exists() and _toml(suite_file) != toml(suite.text):
        raise InputError(
            f"{out} holds another suite ({suite_file} is not {suite.name!r} as it is "
            f"now); {remedy}"
        )
    if environment_file.exists():
        then = _environment(environment_file)
        if then["digest"] != environment["digest"]:
            keys = some(key for key, *_ in differences(then, environment))
            raise InputError(
                f"{out} was measured in another environment ({then['digest']}, now "
                f"{environment['digest']}{keys and f': {keys} changed'}); {remedy}"
            )
    _replace_text(suite_file, suite.text)
    _replace_text(environment_file, json.dumps(environment, indent=1) + "\n")


def suite_text(folder: Path) -> str:
    """Read the suite of a result folder, as TOML.

    Raises
    ------
    InputError
        When it is missing, or no text.

    """
    return read_text(folder / "suite.toml", "the suite of a result folder", MOST_TOML)


def environment_of(folder: Path, digest: str) -> dict[str, Any]:
    """Read the environment of that digest from a result folder.

    Raises
    ------
    InputError
        When the folder does not hold it.

    """
    for path in (folder / "environment.json", _node_file(folder, digest)):
        if path.is_file() and (found := _environment(path))["digest"] == digest:
            return found
    raise InputError(f"{folder} does not hold the environment {digest}")


def keep_environment(folder: Path, digest: str, environment: Mapping[str, Any]) -> None:
    """Store what one machine of a cluster is, under its digest."""
    path = _node_file(folder, digest)
    path.parent.mkdir(exist_ok=True)
    text = json.dumps({"digest": digest, **environment}, indent=1)
    _replace_text(path, text + "\n")


def _node_file(folder: Path, digest: str) -> Path:
    return folder / "environments" / f"{digest}.json"


def differences(
    then: Mapping[str, Any], now: Mapping[str, Any]
) -> Iterator[tuple[str, Any, Any]]:
    """Yield what differs in the lasting parts of two environments.

    As (dotted key, value then, value now); None where there is none.
    """
    for key in sorted((then.keys() | now.keys()) - {"digest", *VOLATILE}):
        a, b = then.get(key), now.get(key)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            yield from ((f"{key}.{k}", *pair) for k, *pair in differences(a, b))
        elif a != b:
            yield key, a, b


def _toml(path: Path) -> dict[str, Any] | None:
    try:
        return read_toml(path)
    except InputError:  # no suite of ours
        return None


def _environment(path: Path) -> dict[str, Any]:
    try:
        environment = read_json(path)
    except InputError:
        environment = None
    if not isinstance(environment, dict) or not isinstance(
        environment.get("digest"), str
    ):
        raise InputError(
            f"{path}: no JSON object with a digest; expected the file that the run "
            "wrote; restore it, or run with --fresh"
        )
    return environment


def _replace_text(path: Path, text: str) -> None:
    """Write a file whole or not at all."""
    temporary = path.with_suffix(".tmp")
    temporary.write_text(text, "utf-8")
    os.replace(temporary, path)
