"""Result folders: checks of their content, suite, environments and lock."""

from __future__ import annotations

import json
import os
import re
import shutil
import stat
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from msgspec import to_builtins

from mortarbench.harness.environment.environment import VOLATILE
from mortarbench.harness.environment.labels import in_words
from mortarbench.harness.errors import InputError, shortened, some
from mortarbench.harness.files.durable import (
    remove_unfinished,
    replace_file,
    report_full_disk,
)
from mortarbench.harness.files.reading import read_json
from mortarbench.harness.processes.locks import file_lock
from mortarbench.harness.suite.growth import refuse_changed
from mortarbench.harness.suite.suite import Suite, as_toml, read_suite

#: Folders and files that commands write to a result folder. ``--fresh`` deletes or
#: overwrites only these and those in `_RESULT_FILES`.
_FOLDERS = ("journal", "vectors", "environments", "report")
_FILES = ("environment.json", "suite.toml")
#: results of `mortarbench validate`
_RESULT_FILES = ("validation.json",)
REMEDY = "choose another --out or use --fresh"
MAX_FOLDER_DEPTH = 30  #: largest depth of nested folders; runs write three levels
_LOCK = ".mortarbench.lock"
_DIGEST = re.compile(r"[\w.-]{1,64}")
_SCRATCH = ".scratch"
#: beginnings of the names of the folders and files of a result folder
_NAMES = (*_FOLDERS, _SCRATCH, _LOCK, "environment.", "suite.", "validation.")


def refuse_links(folder: Path) -> None:
    """Refuse a result folder with links, pipes, devices or too deeply nested folders.

    The folder may come from an untrusted source. Through a link, files outside the
    folder could be overwritten or deleted. Opening a pipe could block forever. Deeply
    nested folders could cause a stack overflow. Files and folders whose names commands
    do not use are ignored.

    Raises
    ------
    InputError
        If there is a link, a device or a pipe, or a folder that is nested too deeply or
        cannot be listed; the message names the first such entry.

    """

    def refuse(e: OSError) -> None:
        raise InputError(
            f"{e.filename}: {e.strerror}; expected a folder that can be read"
        )

    top = str(folder)
    for root, inner, files in os.walk(top, onerror=refuse):
        names, below = [*inner, *files], os.path.relpath(root, top).split(os.sep)
        if root == top:
            inner[:] = [name for name in inner if name in (*_FOLDERS, _SCRATCH)]
            names = [name for name in names if name.startswith(_NAMES)]
        for name in names:
            mode = os.lstat(path := os.path.join(root, name)).st_mode
            if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                raise InputError(
                    f"{path} is a link, pipe or device; expected a regular file or a "
                    "folder, as in every result folder"
                )
        if inner and len(below) >= MAX_FOLDER_DEPTH:
            raise InputError(
                f"{folder / below[0]}: folders nested deeper than {MAX_FOLDER_DEPTH} "
                "levels; expected at most this depth; move the deeper folders away"
            )


def refuse_foreign(folder: Path) -> None:
    """Refuse a folder in which a run would overwrite or delete files of the user.

    Raises
    ------
    InputError
        If `refuse_links` refuses the folder, or if the folder is not a result folder
        and contains files with names that runs use.

    """
    if folder.is_dir():
        refuse_links(folder)
    if all((folder / name).is_file() for name in _FILES):
        return
    if next((folder / "journal").glob("*.jsonl"), None) is not None:
        return
    if (folder / _LOCK).is_file():  # left by a run that was killed immediately
        return
    ours = (*_FOLDERS, *_FILES, *_RESULT_FILES)
    taken = [name for name in ours if os.path.lexists(folder / name)]
    if taken:
        raise InputError(
            f"{folder} contains {some(taken)} but is not a result folder (no "
            "suite.toml with environment.json, no journal/*.jsonl); choose another "
            "--out"
        )


@contextmanager
def lock_folder(folder: Path) -> Iterator[None]:
    """Lock a result folder within the block; create the folder if necessary.

    The lock file identifies a result folder, even if the run is killed before it has
    written any other file. Unfinished files that killed runs left in the
    folder are deleted.

    Raises
    ------
    InputError
        If another run has locked the folder, or the folder cannot be written.

    """
    with ExitStack() as stack:
        try:
            with report_full_disk(folder):
                folder.mkdir(parents=True, exist_ok=True)
                stack.enter_context(
                    file_lock(folder / _LOCK, flags=os.O_CREAT, waits=False)
                )
        except BlockingIOError:
            raise InputError(
                f"{folder} is being written by another run; wait, or choose another "
                "folder"
            ) from None
        except OSError as e:
            raise InputError(
                f"{folder}: {e.strerror}; expected a folder that can be written"
            ) from None
        # Unfinished files are deleted after locking, since another run may still have
        # been writing them.
        remove_unfinished(folder, [folder / name for name in _FOLDERS])
        yield


@contextmanager
def scratch_in(folder: Path) -> Iterator[Path]:
    """Create a temporary folder in a locked result folder, for use within the block.

    The temporary folder is deleted after the block. A temporary folder of a killed run
    is deleted first.
    """
    scratch = folder / _SCRATCH
    shutil.rmtree(scratch, ignore_errors=True)
    scratch.mkdir()
    try:
        yield scratch.resolve()
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def claim(
    out: Path, suite: Suite, environment: Mapping[str, Any], *, fresh: bool
) -> None:
    """Write suite and environment to a locked folder, for a run.

    environment : environment, with its digest under the key ``digest``
    fresh : True to delete previous results first; if False, the caller must have called
        `refuse_other`
    """
    if fresh:
        for name in _FOLDERS:
            shutil.rmtree(out / name, ignore_errors=True)
        for name in _RESULT_FILES:
            (out / name).unlink(missing_ok=True)
    replace_file(out / "suite.toml", as_toml(to_builtins(suite.file)).encode())
    write_json(out / "environment.json", environment)


def refuse_other(out: Path, suite: Suite, environment: Mapping[str, Any]) -> None:
    """Check that a folder belongs to this suite and environment.

    The suite may have been extended, see `harness.suite.growth`.

    environment : environment, with its digest under the key ``digest``

    Raises
    ------
    InputError
        If the suite has changed in another way, or the environment differs; the message
        states the difference and a remedy.

    """
    suite_path, environment_file = out / "suite.toml", out / "environment.json"
    if suite_path.exists():
        try:
            refuse_changed(read_suite(suite_path), suite.file, str(suite_path))
        except InputError as e:
            raise InputError(f"{e}; {REMEDY}") from None
    if environment_file.exists():
        stored = _environment(environment_file)
        if stored["digest"] != environment["digest"]:
            what = in_words(differences(stored, environment), "then", "now")
            raise InputError(
                f"{out} was measured in another environment ({stored['digest']}, now "
                f"{environment['digest']}{what and f': {what}'}); {REMEDY}"
            )


def environment_of(folder: Path, digest: str) -> dict[str, Any]:
    """Read the environment with a given digest from a result folder.

    Raises
    ------
    InputError
        If the folder does not contain the environment, or if the digest or a file is
        malformed.

    """
    # check first, since the digest is part of a path that might lead out of the folder
    if not _DIGEST.fullmatch(digest):
        raise InputError(
            f"{folder}: {shortened(digest)!r} is not the digest of an environment"
        )
    for path in (folder / "environment.json", _node_file(folder, digest)):
        if path.is_file() and (environment := _environment(path))["digest"] == digest:
            return environment
    raise InputError(f"{folder} does not contain the environment {digest}")


def keep_environment(folder: Path, digest: str, environment: Mapping[str, Any]) -> None:
    """Store an environment, such as that of a cluster node, under its digest."""
    write_json(_node_file(folder, digest), {"digest": digest, **environment})


def write_json(path: Path, data: Mapping[str, Any]) -> None:
    """Write data to a JSON file with `replace_file`."""
    replace_file(path, (json.dumps(data, indent=1) + "\n").encode())


def _node_file(folder: Path, digest: str) -> Path:
    return folder / "environments" / f"{digest}.json"


def differences(
    old: Mapping[str, Any], new: Mapping[str, Any]
) -> Iterator[tuple[str, Any, Any]]:
    """Yield the differences between two environments, except load and free memory.

    A difference is (dotted key, old value, new value); a missing value is None.
    """
    for key in sorted((old.keys() | new.keys()) - {"digest", *VOLATILE}):
        a, b = old.get(key), new.get(key)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            yield from ((f"{key}.{k}", *pair) for k, *pair in differences(a, b))
        elif a != b:
            yield key, a, b


def times_compare(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Return True if the environments agree in all values that can affect times.

    A plug-in that occurs in only one of the environments is ignored, since it does not
    affect measurements that are possible in both.
    """
    return all(
        key.startswith("plugins.") and None in values
        for key, *values in differences(one, other)
    )


def _environment(path: Path) -> dict[str, Any]:
    try:
        environment = read_json(path)
    except InputError:
        environment = None
    if not isinstance(environment, dict) or not isinstance(
        environment.get("digest"), str
    ):
        raise InputError(
            f"{path}: not a JSON object with a digest; expected the file that the run "
            "wrote; restore it, or run with --fresh"
        )
    return environment
