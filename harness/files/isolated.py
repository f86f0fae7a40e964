"""Reading of .mat and Parquet files in a process of `harness.files.reader`."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO, Any

from numpy.typing import NDArray

from mortarbench.harness.errors import InputError
from mortarbench.harness.files import reader
from mortarbench.harness.files.npz import arrays_in
from mortarbench.harness.files.reading import MIB, VARIABLE, max_bytes


def read_isolated(
    file: IO[bytes], path: Path, wrong: str, *arguments: str
) -> dict[str, NDArray[Any]]:
    """Read the arrays of a file in a separate process that a damaged file may crash.

    file : open file, from its beginning
    path : path of the file for messages
    wrong : message if the file cannot be read
    arguments : arguments of `harness.files.reader`, its limit excepted

    Raises
    ------
    InputError
        If the file cannot be read, or its data exceed the limit of
        `harness.files.reading`.

    """
    most = max_bytes()
    command = [sys.executable, "-I", reader.__file__, str(most), *arguments]
    with TemporaryFile() as archive:
        done = subprocess.run(
            command, stdin=file, stdout=archive, stderr=subprocess.DEVNULL, check=False
        )
        if done.returncode == reader.TOO_LARGE:
            raise InputError(
                f"{path}: its content would take more than {most // MIB} MiB of "
                f"memory; expected less (set {VARIABLE} to allow more)"
            )
        if done.returncode:
            raise InputError(f"{path}: {wrong}")
        archive.seek(0)
        try:
            return arrays_in(archive, path)
        except ValueError:  # damaged names
            raise InputError(f"{path}: {wrong}") from None
