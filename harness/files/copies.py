"""Copies of the input files of cases: ``FOLDER/files/DIGEST.SUFFIX``.

To make a result folder self-contained, each file that defines a QP is copied into the
folder, unless the file, or the total size of the copies, would be too large. Files with
equal content share one copy. The list ``files/copies.json`` contains the paths that
occur in the names of cases, including the paths of files that were not copied. Readers
compare these paths with the names of cases and never open them.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from mortarbench.harness.checked import has_control
from mortarbench.harness.digest import hex_digest, pieces, running_digest
from mortarbench.harness.errors import InputError, shortened, some
from mortarbench.harness.files.datafile import MIB, opened
from mortarbench.harness.files.durable import replace_file, replacing
from mortarbench.harness.files.reading import read_json
from mortarbench.harness.plugin import SourceFile

FOLDER = "files"
LIST = "copies.json"
#: size of the largest file that is copied, so that results remain small enough to send
MAX_FILE_MIB = 64
MAX_FOLDER_MIB = 256  #: largest total size of the copies in a result folder

#: number of hex digits of the SHA-256 that identify a file, as in case parameters
_DIGITS = 12
_COPY = re.compile(rf"([0-9a-f]{{{_DIGITS}}})((?:\.[a-z0-9]{{1,8}}){{1,2}})")


def content_digest(*paths: Path) -> str:
    """Return 12 hexadecimal digits of the SHA-256 of the concatenated files.

    Raises
    ------
    InputError
        If a file cannot be read, is not a regular file, or is larger than
        `harness.files.datafile` allows.

    """

    def parts() -> Iterator[bytes]:
        for path in paths:
            with opened(path, "a readable file") as file:
                yield from pieces(file)

    return hex_digest(parts(), _DIGITS)


def is_copy(name: str) -> bool:
    """Return True if `name` has the form of the names of copies in ``files/``."""
    return name == LIST or _COPY.fullmatch(name) is not None


class _Entry(NamedTuple):
    """Entry of ``copies.json``."""

    path: str  #: path of the file as it occurs in the names of cases
    sha256: str  #: first digits of the SHA-256 of the content
    size: int  #: size of the file in bytes


class Copies:
    """Lookup of input files of cases, with the copies in a result folder as fallback.

    A copy is used only if the original file is missing or has changed.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder / FOLDER

    def locate(self, source: SourceFile) -> Path:
        """Return the path of the original file if its digest matches, or of its copy.

        Raises
        ------
        InputError
            If neither the original with this digest nor a copy exists, or the content
            of the copy has a different digest.

        """
        here = _digest_if_there(Path(source.path))
        if here == source.sha256:
            return Path(source.path)
        name = f"{source.sha256}{source.suffix}"
        if not _COPY.fullmatch(
            name
        ):  # a path separator in the name could lead out of the folder
            raise InputError(
                f"{shortened(source.path)}: {shortened(source.sha256)!r} is not a "
                f"digest; expected {_DIGITS} hex digits"
            )
        copy = self._folder / name
        if not os.path.lexists(copy):
            raise self._missing(source.path, source.sha256, here)
        check_copy(copy, source.sha256, f"restore the file at {source.path}")
        return copy

    def digest(self, path: str) -> str:
        """Return the digest of a file or, if it is missing, its digest in the list.

        Raises
        ------
        InputError
            If the file is neither at its path nor in the list of copies, or the list
            has several versions of the file.

        """
        if os.path.lexists(path):
            return content_digest(Path(path))
        digests = {e.sha256 for e in _entries(self._folder) if e.path == path}
        if not digests:
            return content_digest(
                Path(path)
            )  # raises InputError, since there is no such file
        if len(digests) > 1:
            raise InputError(
                f"{path} does not exist, and {self._folder} has {len(digests)} "
                f"versions of it (sha256 {some(sorted(digests))}); put the right one "
                f"at {path}"
            )
        return digests.pop()

    def paths(self) -> list[str]:
        """Return the listed paths of files, as they occur in the names of cases."""
        return sorted({entry.path for entry in _entries(self._folder)})

    def _missing(self, path: str, digest: str, here: str | None) -> InputError:
        """Return the error for a file without an available original or copy."""
        sizes = {e.size for e in _entries(self._folder) if e.sha256 == digest}
        why = f"has no copy in {self._folder}"
        if sizes and (size := max(sizes)) > MAX_FILE_MIB * MIB:
            why = f"was too large to be copied with the results ({_mib(size)})"
        other = (
            (f" (the file has changed; its digest is now {here})")
            if here is not None
            else ""
        )
        return InputError(
            f"{Path(path).name} (sha256 {digest}) is not available{other} and {why}; "
            f"put it at {path}"
        )


def check_copy(copy: Path, digest: str, remedy: str) -> None:
    """Check that the content of a copy has the digest in its name.

    Raises
    ------
    InputError
        If the digests differ, or the copy cannot be read or is too large; the message
        names the file and the remedy.

    """
    with opened(copy, "the copy of a file") as file:
        size = os.fstat(file.fileno()).st_size
        if size > MAX_FILE_MIB * MIB:
            raise InputError(
                f"{copy}: {_mib(size)}; expected at most {MAX_FILE_MIB} MiB; {remedy}"
            )
        actual = hex_digest(pieces(file), _DIGITS)
    if actual != digest:
        raise InputError(
            f"{copy}: its content has the digest {actual}, not {digest}: it was "
            f"damaged or replaced; {remedy}"
        )


def check_copies(folder: Path) -> None:
    """Check all copies in a result folder with `check_copy`.

    Raises
    ------
    InputError
        If a copy fails the check; the message names the first such copy.

    """
    for copy, digest, _ in copies_in(folder):
        check_copy(copy, digest, "restore it, or delete it")


def keep_copies(
    folder: Path, sources: Iterable[SourceFile], tell: Callable[[str], None]
) -> None:
    """Copy the input files of cases into a result folder; equal files share one copy.

    tell : called with a message for each file that is not copied because of its size or
        of the total size of the copies

    Raises
    ------
    InputError
        If a file has changed since its case was named, or cannot be read.

    """
    distinct = {(s.path, s.sha256): s for s in sources}.values()
    if not distinct:
        return
    writer = _Writer(folder, tell)
    for source in distinct:
        writer.keep(Path(source.path), source.sha256, source.suffix, source.path)
    writer.write_list()


def merge_copies(
    sources: Sequence[Path], out: Path, tell: Callable[[str], None]
) -> None:
    """Merge the copies in several result folders into `out`, without duplicates.

    tell : called with a message for each file that is not copied because of its size or
        of the total size of the copies
    """
    writer = _Writer(out, tell)
    for source in sources:
        paths: dict[str, str] = {}
        for entry in _entries(source / FOLDER):
            paths.setdefault(entry.sha256, entry.path)
            writer.add(entry)
        for copy, digest, suffix in copies_in(source):
            writer.keep(copy, digest, suffix, paths.get(digest))
    writer.write_list()


def copies_in(folder: Path) -> list[tuple[Path, str, str]]:
    """Return the path, the digest and the suffix of each copy in a result folder."""
    copies = []
    for name in _names(folder / FOLDER):
        if match := _COPY.fullmatch(name):
            copies.append((folder / FOLDER / name, match[1], match[2]))
    return copies


def remove_copies(folder: Path) -> None:
    """Delete the copies in a result folder and ``copies.json``, but no other files."""
    for name in filter(is_copy, _names(folder / FOLDER)):
        (folder / FOLDER / name).unlink(missing_ok=True)


def refuse_own_copies(folder: Path, sources: Iterable[SourceFile]) -> None:
    """Check that no case reads its input from a copy that is about to be deleted.

    Raises
    ------
    InputError
        If a case reads its input from such a copy; the message names the copy.

    """
    copies = (folder / FOLDER).resolve()
    for path in {s.path for s in sources}:
        real = Path(path).resolve()
        if real.parent == copies and is_copy(real.name):
            raise InputError(
                f"{path} is a copy that --fresh deletes; put the file elsewhere, or "
                "choose another --out"
            )


class _Writer:
    """Writer of the copies and their list in one result folder."""

    def __init__(self, folder: Path, tell: Callable[[str], None]) -> None:
        self._folder = folder / FOLDER
        self._tell = tell
        self._before = _entries(self._folder)
        self._entries = dict.fromkeys(self._before)
        self._size = sum(p.stat().st_size for p, *_ in copies_in(folder))

    def add(self, entry: _Entry) -> None:
        """Add an entry to the list, without copying the file."""
        self._entries[entry] = None

    def keep(self, original: Path, digest: str, suffix: str, name: str | None) -> None:
        """Copy a file, unless an intact copy exists or the sizes forbid it.

        name : path to list, as in the names of cases; None if unknown
        """
        copy = self._folder / f"{digest}{suffix}"
        if os.path.lexists(copy) and _digest_if_there(copy) == digest:
            if name is not None:
                self.add(_Entry(name, digest, copy.stat().st_size))
            return
        with opened(original, "a readable file") as file:
            size = os.fstat(file.fileno()).st_size
            if name is not None:
                self.add(_Entry(name, digest, size))
            if not self._has_room(name or copy.name, size):
                return
            self._folder.mkdir(parents=True, exist_ok=True)
            with replacing(copy) as new:
                content = running_digest(())
                for piece in pieces(file):
                    content.update(piece)
                    new.write(piece)
                if (actual := content.hexdigest()[:_DIGITS]) != digest:
                    raise InputError(
                        f"{original}: its content has the digest {actual}, not "
                        f"{digest}; it changed while it was read; start again"
                    )
        self._size += size

    def _has_room(self, name: str, size: int) -> bool:
        if size > MAX_FILE_MIB * MIB:
            self._tell(
                f"{name} ({_mib(size)}) is larger than {MAX_FILE_MIB} MiB, and is "
                "not copied to the result folder"
            )
            return False
        if self._size + size > MAX_FOLDER_MIB * MIB:
            self._tell(
                f"{name} ({_mib(size)}) is not copied to the result folder: the copies "
                f"of files would take more than {MAX_FOLDER_MIB} MiB"
            )
            return False
        return True

    def write_list(self) -> None:
        """Write the list of files if it has changed."""
        if list(self._entries) == self._before:
            return
        data = {"files": [entry._asdict() for entry in self._entries]}
        text = json.dumps(data, indent=1) + "\n"
        replace_file(self._folder / LIST, text.encode())


def _digest_if_there(path: Path) -> str | None:
    """Return the digest of a file, or None if it cannot be read."""
    try:
        return content_digest(path)
    except InputError:
        return None


def _names(folder: Path) -> list[str]:
    if not folder.is_dir():
        return []
    with os.scandir(folder) as entries:
        return sorted(entry.name for entry in entries)


def _entries(folder: Path) -> list[_Entry]:
    """Read the list of copies in a folder; the result is empty if there is no list.

    Raises
    ------
    InputError
        If the list is malformed.

    """
    path = folder / LIST
    if not os.path.lexists(path):
        return []
    try:
        data = read_json(path, "the list of copied files")
        entries = [_Entry(**entry) for entry in data["files"]]
    except (TypeError, KeyError):
        entries = [_Entry("", "", -1)]
    if not all(map(_is_sound, entries)):
        raise InputError(
            f"{path}: malformed list of copied files; restore or delete it; the "
            "copies of measured cases are found without this list"
        )
    return entries


def _is_sound(entry: _Entry) -> bool:
    texts = isinstance(entry.path, str) and isinstance(entry.sha256, str)
    return (
        texts
        and 0 < len(entry.path) <= 4096
        and not has_control(entry.path)
        and re.fullmatch(f"[0-9a-f]{{{_DIGITS}}}", entry.sha256) is not None
        and type(entry.size) is int
        and 0 <= entry.size < 2**63
    )


def _mib(size: int) -> str:
    return f"{size / MIB:.3g} MiB"
