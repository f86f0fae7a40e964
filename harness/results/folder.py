"""A result folder: held by one run at a time, of one suite in one environment."""

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
from mortarbench.harness.suite.growth import refused
from mortarbench.harness.suite.suite import Suite, read_stored

#: all that a run writes, and what is made of it; `fresh` deletes that, nothing else
_FOLDERS = ("journal", "vectors", "cases", "environments", "references", "report")
_FILES = ("environment.json", "suite.toml")
_CONCLUDED = ("validation.json", FAULTS)  #: of `mortarbench validate`, and of faults
REMEDY = "choose another --out or use --fresh"
MOST_LEVELS = 30  #: of folders in those of a run, which nests three
_LOCK = ".lock"
_MARK = b"held by runs of mortarbench\n"  #: what is in it
_DIGEST = re.compile(r"[\w.-]{1,64}")
_SCRATCH = ".scratch"
#: how the names of files begin that are written beside the folders
_BESIDE = (_LOCK, FAULTS, "environment.", "suite.", "validation.", "discretisation.")


def refuse_links(folder: Path) -> None:
    """Refuse a result folder that leads out of itself, or to what is no file.

    It may come from anybody. A link in it would have us write over, or delete, a file
    elsewhere; a pipe would have us wait for ever; folders nested without end lead any
    recursion astray.

    Raises
    ------
    InputError
        With the first link, device or pipe, a folder that is nested too deeply, or one
        that cannot be listed.

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
                elif entry.name.startswith(_BESIDE) and not _is_plain(entry):
                    raise _not_plain(entry.path, "a file of its own")
    except OSError as e:
        raise InputError(
            f"{e.filename}: {e.strerror}; expected a folder that can be read"
        ) from None


def _only_plain(folder: str) -> None:
    """Refuse links, pipes and devices in a folder, and folders nested too deeply."""
    level = [folder]
    for _ in range(MOST_LEVELS):
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
            f"{folder}: folders nested deeper than {MOST_LEVELS} levels; expected "
            "those that a run writes; move the deep ones away"
        )


def _only_plain_copies(folder: os.DirEntry[str]) -> None:
    """Refuse links, pipes and devices among copies of files.

    A folder of that name may be a user's own: what has no name of ours is left alone.
    """
    if folder.is_symlink():
        raise _not_plain(folder.path, "a folder of its own")
    if not folder.is_dir():
        return
    with os.scandir(folder.path) as entries:
        for entry in entries:
            if is_copy(entry.name) and not entry.is_file(follow_symlinks=False):
                raise InputError(
                    f"{entry.path} is not a regular file; expected the copy of a file, "
                    "as in every result folder"
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
    """Refuse a folder where we would write over, or delete, what is not ours.

    Raises
    ------
    InputError
        When something there has a name that we use, but no run made it, or is a link.

    """
    if folder.is_dir():
        refuse_links(folder)
    if all((folder / name).is_file() for name in _FILES):
        return
    if next((folder / "journal").glob("*.jsonl"), None) is not None:
        return
    with suppress(InputError), opened(folder / _LOCK) as lock:
        if lock.read(len(_MARK) + 1) == _MARK:  # of a run that was cut off at once
            return
    ours = (*_FOLDERS, *_FILES, *_CONCLUDED)
    taken = [name for name in ours if os.path.lexists(folder / name)]
    if taken:
        raise InputError(
            f"{folder} holds {some(taken)} but is no result folder (no suite.toml with "
            "environment.json, no journal/*.jsonl); choose another --out"
        )


class Held:
    """A result folder that this process holds against every other run.

    Raises
    ------
    InputError
        When another run holds it.
    OSError
        When it cannot be made or written.

    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._take()

    def is_there(self) -> bool:
        """Whether it is still the folder that we took; if not, it was deleted.

        A lock that was deleted is taken anew, and so is a folder.

        Raises
        ------
        InputError
            When the folder was moved away, or another run took it meanwhile.

        """
        there = _leads_to(self._folder, self._there)
        if not there:
            now = os.readlink(f"/proc/self/fd/{self._there}")
            if not now.endswith(" (deleted)"):
                raise InputError(
                    f"{self._folder} was moved to {now} while the run wrote to it; all "
                    "that was measured is there, and --out with that path continues"
                )
        if not (there and _leads_to(self._folder / _LOCK, self._lock)):
            self.close()
            self._take()
        return there

    def _take(self) -> None:
        self._folder.mkdir(parents=True, exist_ok=True)
        self._lock = _locked(self._folder)
        flags = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC
        self._there = os.open(self._folder, flags)

    def close(self) -> None:
        """Let others have it."""
        for name in ("_lock", "_there"):
            if (fd := vars(self).pop(name, None)) is not None:
                os.close(fd)  # which unlocks


@contextmanager
def locked(folder: Path) -> Iterator[Held]:
    """Keep every other run off a result folder, which is made if need be.

    What writers that were killed left unfinished there is deleted.

    Raises
    ------
    InputError
        When another run holds it, or it cannot be written.

    """
    try:
        with report_full_disk(folder):
            held = Held(folder)
    except OSError as e:
        raise InputError(
            f"{folder}: {e.strerror}; expected a folder that can be written"
        ) from None
    try:
        own = [folder / name for name in _FOLDERS]
        remove_unfinished(folder, own, shared=[folder / COPIES])
        yield held
    finally:
        held.close()


def _locked(folder: Path) -> int:
    """Open the lock of a folder and lock it, until the file descriptor is closed.

    The file tells, too, that one of our runs began here: one that was killed at once
    left nothing else by which it could be known.
    """
    flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW
    while True:
        fd = os.open(folder / _LOCK, flags, 0o666)
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _leads_to(folder / _LOCK, fd):  # else it was deleted before we locked it
                os.pwrite(fd, _MARK, 0)
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


def _leads_to(path: Path, fd: int) -> bool:
    """Whether a path is that of an open file or folder."""
    try:
        return os.path.samestat(path.stat(), os.fstat(fd))
    except FileNotFoundError:
        return False


@contextmanager
def scratch_in(folder: Path) -> Iterator[Path]:
    """Make room in a locked folder for files that only last as long as a run.

    What a killed run left there is deleted first.
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
    """Make a locked folder that of this suite in this environment.

    environment : with its digest under the key ``digest``
    fresh : forget first what the folder holds; see `refuse_other` if not
    """
    if fresh:
        for name in _FOLDERS:
            shutil.rmtree(out / name, ignore_errors=True)
        for name in _CONCLUDED:
            (out / name).unlink(missing_ok=True)
        remove_copies(out)
    describe(out, suite, environment)


def describe(out: Path, suite: Suite, environment: Mapping[str, Any]) -> None:
    """Write down what is measured, and where; `environment` as for `claim`."""
    replace_file(out / "suite.toml", suite.text.encode())
    text = json.dumps(environment, indent=1) + "\n"
    replace_file(out / "environment.json", text.encode())


def refuse_other(out: Path, suite: Suite, environment: Mapping[str, Any]) -> bool:
    """Refuse a folder of another suite or environment; tell whether the suite grew.

    environment : as for `claim`

    Raises
    ------
    InputError
        With what differs, and what to do.

    """
    suite_file, environment_file = out / "suite.toml", out / "environment.json"
    has_grown = False
    if suite_file.exists():
        try:
            before, now = read_stored(suite_file), toml(suite.text)
        except InputError as e:
            raise InputError(f"{e}; restore it, or use --fresh") from None
        has_grown = before != now
        if has_grown and (changed := refused(before, now)):
            raise InputError(f"{out} holds another suite ({changed}); {REMEDY}")
    if environment_file.exists():
        then = _environment(environment_file)
        if then["digest"] != environment["digest"]:
            what = in_words(differences(then, environment), "then", "now")
            raise InputError(
                f"{out} was measured in another environment ({then['digest']}, now "
                f"{environment['digest']}{what and f': {what}'}); {REMEDY}"
            )
    return has_grown


def suite_text(folder: Path) -> str:
    """Read the suite of a result folder, as TOML.

    Raises
    ------
    InputError
        When it is missing, or no suite.

    """
    path = folder / "suite.toml"
    read_stored(path)
    return read_text(path, "the suite of a result folder", MAX_TOML_MIB)


def environment_of(folder: Path, digest: str) -> dict[str, Any]:
    """Read the environment of that digest from a result folder.

    Raises
    ------
    InputError
        When the folder does not hold it, or it is none.

    """
    if not _DIGEST.fullmatch(digest):  # it could lead out of the folder
        raise InputError(f"{folder}: {shortened(digest)!r} is no environment's digest")
    for path in (folder / "environment.json", _node_file(folder, digest)):
        if path.is_file() and (found := _environment(path))["digest"] == digest:
            return found
    raise InputError(f"{folder} does not hold the environment {digest}")


def keep_environment(folder: Path, digest: str, environment: Mapping[str, Any]) -> None:
    """Store what one machine of a cluster is, under its digest."""
    text = json.dumps({"digest": digest, **environment}, indent=1) + "\n"
    replace_file(_node_file(folder, digest), text.encode())


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


def times_compare(one: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Return whether two environments agree in all that can change a time.

    A plug-in that only one of them has changes no time of what both can measure.
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
            f"{path}: no JSON object with a digest; expected the file that the run "
            "wrote; restore it, or run with --fresh"
        )
    return environment
