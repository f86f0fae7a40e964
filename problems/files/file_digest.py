"""What a case rests on when it comes from files: their format and content, by digest.

Text and .mat files may be compressed by gzip; npz and Parquet are compressed as it is.
"""

from __future__ import annotations

from pathlib import Path

from mortarbench.harness import InputError, Value
from mortarbench.harness.errors import unknown

COMPRESSIBLE = (".qps", ".mps", ".sif", ".mat")
FORMATS = (".npz", ".parquet", *COMPRESSIBLE)  #: suffixes of QP files


def format_of(path: Path) -> str:
    """Name the format of a QP file by its suffix, without a .gz that it has besides.

    Raises
    ------
    InputError
        For a suffix that names none.

    """
    suffix = path.suffix.lower()
    if suffix in FORMATS:
        return suffix
    if suffix == ".gz":
        inner = Path(path.stem).suffix.lower()
        if inner in COMPRESSIBLE:
            return inner
        known = " or ".join(f"{s}.gz" for s in COMPRESSIBLE)
        raise InputError(f"{path}: {inner}.gz is not read; expected {known}")
    raise unknown("format", path.suffix, (*FORMATS, ".gz"), where=str(path))


def check_digest(path: Value, asked: Value, found: str) -> None:
    """Raise InputError unless the content is what the case was named for."""
    if asked != found:
        raise InputError(
            f"{path}: its content has the digest {found}, not {asked}; "
            "the file changed, or another one was meant"
        )
