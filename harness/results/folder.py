"""Result folder: locked by one run at a time, for one suite and one environment."""

from __future__ import annotations

import fcntl
import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from mortarbench.harness.environment.environment import VOLATILE
from mortarbench.harness.environment.labels import in_words
from mortarbench.harness.errors import InputError, shortened, some
from mortarbench.harness.files.copies import FOLDER as COPIES
from mortarbench.harness.files.copies import is_copy, remove_copies
from mortarbench.harness.files.durable import (
    remove_unfinished,
    replace_file,
    report_full_disk,
)
from mortarbench.harness.files.reading import (
    MAX_TOML_MIB,
    opened,
    read_json,
    read_text,
    toml,
)
from mortarbench.harness.results.faults import FAULTS
from mortarbench.harness.suite.growth import incompatibility
from mortarbench.harness.suite.suite import Suite, read_stored

#: everything that a run and its evaluations write; `fresh` deletes these, nothing else
_FOLDERS = ("journal", "vectors", "cases", "environments", "references", "report")
_FILES = ("environment.json", "suite.toml")
#: file written by `mortarbench validate`, and file of the faults of runs
_RESULT_FILES = ("validation.json", FAULTS)
REMEDY = "choose another --out or use --fresh"
MAX_FOLDER_DEPTH = 30  #: levels accepted in a result folder; runs write three
_LOCK = ".lock"
_LOCK_CONTENT = b"held by runs of mortarbench\n"
_DIGEST = re.compile(r"[\w.-]{1,64}")
_SCRATCH = ".scratch"
#: beginnings of the names of files that are written beside the folders
_FILE_PREFIXES = (
    _LOCK,
    FAULTS,
    "environment.",
    "suite.",
    "validation.",
    "discretisation.",
)


def refuse_links(folder: Path) -> None:
    """Refuse a result folder that contains links, pipes, devices or too deep nesting.

    The folder may come from anyone. Through a link, files elsewhere would be
    overwritten or deleted; opening a pipe would block for ever; deeply nested folders
    would exhaust any recursion.

    Raises
    ------
    InputError
        If there is a link, device or pipe, a folder that is nested too deeply, or one
        that cannot be listed; the message names the first.

    """
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                if entry.name in (*_FOLDERS, _SCRATCH):
                    if not _is_plain(entry):
                        raise _not_plain(entry.path, "a folder of its own")
                    if entry.is_dir(follow_symlinks=False):
                        _only_plain(entry.path)
                elif entry.name == COPIES:
                    _only_plain_copies(entry)
                elif entry.name.startswith(_FILE_PREFIXES) and not _is_plain(entry):
                    raise _not_plain(entry.path, "a file of its own")
    except OSError as e:
        raise InputError(
            f"{e.filename}: {e.strerror}; expected a folder that can be read"
        ) from None


def _only_plain(folder: str) -> None:
    """Refuse links, pipes and devices in a folder, and folders nested too deeply."""
    level = [folder]
    for _ in range(MAX_FOLDER_DEPTH):
        inner = []
        for each in level:
            with os.scandir(each) as entries:
                for entry in entries:
                    if not _is_plain(entry):
                        raise _not_plain(entry.path, "a file or folder of its own")
                    if entry.is_dir(follow_symlinks=False):
                        inner.append(entry.path)
        level = inner
    if level:
        raise InputError(
            f"{folder}: folders nested deeper than {MAX_FOLDER_DEPTH} levels; expected "
            "those that a run writes; move the deep ones away"
        )


def _only_plain_copies(folder: os.DirEntry[str]) -> None:
    """Refuse links, pipes and devices among copies of files.

    The folder may be a user's own of the same name, so other files in it are ignored.
    """
    if folder.is_symlink():
        raise _not_plain(folder.path, "a folder of its own")
    if not folder.is_dir():
        return
    with os.scandir(folder.path) as entries:
        for entry in entries:
            if is_copy(entry.name) and not entry.is_file(follow_symlinks=False):
                raise InputError(
                    f"{entry.path} is not a regular file; expected a copy of an input "
                    "file, as in every result folder"
                )


def _is_plain(entry: os.DirEntry[str]) -> bool:
    is_file = entry.is_file(follow_symlinks=False)
    return is_file or entry.is_dir(follow_symlinks=False)


def _not_plain(path: str, expected: str) -> InputError:
    return InputError(
        f"{path} is a link, pipe or device; expected {expected}, as in every result "
        "folder"
    )


def refuse_foreign(folder: Path) -> None:
    """Refuse a folder in which a run would overwrite or delete files of others.

    Raises
    ------
    InputError
        If it contains a link, or if no run has written it but it contains files with
        names that runs use.

    """
    if folder.is_dir():
        refuse_links(folder)
    if all((folder / name).is_file() for name in _FILES):
        return
    if next((folder / "journal").glob("*.jsonl"), None) is not None:
        return
    with suppress(InputError), opened(folder / _LOCK) as lock:
        # left by a run that was killed before it wrote anything else
        if lock.read(len(_LOCK_CONTENT) + 1) == _LOCK_CONTENT:
            return
    ours = (*_FOLDERS, *_FILES, *_RESULT_FILES)
    taken = [name for name in ours if os.path.lexists(folder / name)]
    if taken:
        raise InputError(
            f"{folder} holds {some(taken)} but is not a result folder (no suite.toml "
            "with environment.json, no journal/*.jsonl); choose another --out"
        )


class FolderLock:
    """Lock of a result folder against every other run.

    Raises
    ------
    InputError
        If another run has locked it.
    OSError
        If it cannot be created or written.

    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._take()

    def is_there(self) -> bool:
        """Return True if the path still leads to the locked folder, False if deleted.

        A deleted folder, or a deleted lock, is created and locked again.

        Raises
        ------
        InputError
            If the folder was moved, or another run locked it meanwhile.

        """
        is_there = _is_same_file(self._folder, self._folder_fd)
        if not is_there:
            path = os.readlink(f"/proc/self/fd/{self._folder_fd}")
            if not path.endswith(" (deleted)"):
                raise InputError(
                    f"{self._folder} was moved to {path} while the run wrote to it; "
                    "all measurements are there, and --out with that path continues"
                )
        if not (is_there and _is_same_file(self._folder / _LOCK, self._lock)):
            self.close()
            self._take()
        return is_there

    def _take(self) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        self._lock = _open_lock(self._folder)
        flags = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC
        self._folder_fd = os.open(self._folder, flags)

    def close(self) -> None:
        """Release the lock."""
        for name in ("_lock", "_folder_fd"):
            if (fd := vars(self).pop(name, None)) is not None:
                os.close(fd)


@contextmanager
def lock_folder(folder: Path) -> Iterator[FolderLock]:
    """Lock a result folder against every other run, creating it if necessary.

    Unfinished files of writers that were killed are deleted.

    Raises
    ------
    InputError
        If another run has locked it, or it cannot be written.

    """
    try:
        with report_full_disk(folder):
            lock = FolderLock(folder)
    except OSError as e:
        raise InputError(
            f"{folder}: {e.strerror}; expected a folder that can be written"
        ) from None
    try:
        # only now: while another run had the lock, these files were not left over
        folders = [folder / name for name in _FOLDERS]
        remove_unfinished(folder, folders, shared=[folder / COPIES])
        yield lock
    finally:
        lock.close()


def _open_lock(folder: Path) -> int:
    """Lock a folder until the returned file descriptor is closed.

    The content of the lock file marks the folder as one of ours: a run that was killed
    at once leaves nothing else by which it could be recognised.
    """
    # if the lock were a link, a file elsewhere would be overwritten
    flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
    while True:  # until the locked file is the one at the path
        fd = os.open(folder / _LOCK, flags, 0o666)
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # without this, the lock would be on a file deleted between open and flock
            if _is_same_file(folder / _LOCK, fd):
                os.pwrite(fd, _LOCK_CONTENT, 0)
                return fd
        except BlockingIOError:
            os.close(fd)
            raise InputError(
                f"{folder} is being written by another run; wait, or choose another"
            ) from None
        except BaseException:
            os.close(fd)
            raise
        os.close(fd)


def _is_same_file(path: Path, fd: int) -> bool:
    """Return True if a path leads to an open file or folder."""
    try:
        return os.path.samestat(path.stat(), os.fstat(fd))
    except FileNotFoundError:
        return False


@contextmanager
def scratch_in(folder: Path) -> Iterator[Path]:
    """Create a temporary folder in a locked result folder, for the duration of a run.

    Files that a killed run left there are deleted first.
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
    """Assign a locked folder to a suite and an environment.

    environment : environment, with its digest under the key ``digest``
    fresh : delete the previous content first; without it, call `refuse_other` before
    """
    if fresh:
        for name in _FOLDERS:
            shutil.rmtree(out / name, ignore_errors=True)
        for name in _RESULT_FILES:
            (out / name).unlink(missing_ok=True)
        remove_copies(out)
    describe(out, suite, environment)


def describe(out: Path, suite: Suite, environment: Mapping[str, Any]) -> None:
    """Write the suite and the environment; `environment` as for `claim`."""
    replace_file(out / "suite.toml", suite.text.encode())
    text = json.dumps(environment, indent=1) + "\n"
    replace_file(out / "environment.json", text.encode())


def refuse_other(out: Path, suite: Suite, environment: Mapping[str, Any]) -> bool:
    """Refuse a folder of another suite or environment.

    environment : see `claim`

    Returns
    -------
    True if the suite has changed, which it may only by asking for more

    Raises
    ------
    InputError
        If they differ; the message names the difference and the remedy.

    """
    suite_file, environment_file = out / "suite.toml", out / "environment.json"
    has_grown = False
    if suite_file.exists():
        try:
            old, new = read_stored(suite_file), toml(suite.text)
        except InputError as e:
            raise InputError(f"{e}; restore it, or use --fresh") from None
        has_grown = old != new
        if has_grown and (difference := incompatibility(old, new)):
            raise InputError(f"{out} holds another suite ({difference}); {REMEDY}")
    if environment_file.exists():
        stored = _environment(environment_file)
        if stored["digest"] != environment["digest"]:
            what = in_words(differences(stored, environment), "then", "now")
            raise InputError(
                f"{out} was measured in another environment ({stored['digest']}, now "
                f"{environment['digest']}{what and f': {what}'}); {REMEDY}"
            )
    return has_grown


def suite_text(folder: Path) -> str:
    """Return the TOML of the suite of a result folder.

    Raises
    ------
    InputError
        If the file is missing, or not a suite.

    """
    path = folder / "suite.toml"
    read_stored(path)
    return read_text(path, "the suite of a result folder", MAX_TOML_MIB)


def environment_of(folder: Path, digest: str) -> dict[str, Any]:
    """Read the environment of a digest from a result folder.

    Raises
    ------
    InputError
        If the folder does not contain it, or the digest or the file is malformed.

    """
    if not _DIGEST.fullmatch(digest):  # as a path it could lead out of the folder
        raise InputError(
            f"{folder}: {shortened(digest)!r} is not the digest of an environment"
        )
    for path in (folder / "environment.json", _node_file(folder, digest)):
        if path.is_file() and (environment := _environment(path))["digest"] == digest:
            return environment
    raise InputError(f"{folder} does not hold the environment {digest}")


def keep_environment(folder: Path, digest: str, environment: Mapping[str, Any]) -> None:
    """Store the environment of one machine of a cluster under its digest."""
    text = json.dumps({"digest": digest, **environment}, indent=1) + "\n"
    replace_file(_node_file(folder, digest), text.encode())


def _node_file(folder: Path, digest: str) -> Path:
    return folder / "environments" / f"{digest}.json"


def differences(
    old: Mapping[str, Any], new: Mapping[str, Any]
) -> Iterator[tuple[str, Any, Any]]:
    """Yield the differences between the lasting parts of two environments.

    Each is (dotted key, old value, new value); a missing value is None.
    """
    for key in sorted((old.keys() | new.keys()) - {"digest", *VOLATILE}):
        a, b = old.get(key), new.get(key)
        if isinstance(a, Mapping) and isinstance(b, Mapping):
            yield from ((f"{key}.{k}", *pair) for k, *pair in differences(a, b))
        elif a != b:
            yield key, a, b


def times_compare(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Return True if the environments agree in everything that can affect times.

    A plug-in that only one of them has does not affect measurements that both can make.
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
