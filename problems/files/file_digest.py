"""Formats and digests of QP files.

Text and .mat files may be compressed by gzip; npz and Parquet have their own
compression.
"""

from __future__ import annotations

from pathlib import Path

from mortarbench.harness import InputError, Value
from mortarbench.harness.errors import unknown

COMPRESSIBLE = (".qps", ".mps", ".sif", ".mat")
FORMATS = (".npz", ".parquet", *COMPRESSIBLE)  #: suffixes of QP files


def format_of(path: Path) -> str:
    """Return the suffix of a QP file that indicates its format, ignoring a final .gz.

    Raises
    ------
    InputError
        If the suffix is unknown.

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


def check_digest(path: Value, expected: Value, actual: str) -> None:
    """Raise InputError if the digest of a file differs from that in its case name."""
    if expected != actual:
        raise InputError(
            f"{path}: its content has the digest {actual}, not {expected}; "
            "the file changed, or a different file was meant"
        )
