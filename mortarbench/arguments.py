"""Checks of what a user asks for, before any work is done or any library loads."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from numbers import Real
from pathlib import Path
from typing import Any

from mortarbench.harness import checked
from mortarbench.harness.errors import InputError, shown, unknown

EXPORTS = (".npz", ".mat", ".parquet", ".qps")  #: files that a QP is written to
PICTURES = (".png", ".pdf", ".svg")
FORMATS = ("html", "md", "tex", "csv", "parquet")  #: of a report
GATES = ("worse", "slower")  #: what a comparison may fail on
MOST_SCALE = 1e9  #: of displacements in pictures
GRIDS = (".vtu", ".pvd")  #: for ParaView: one state, or a series of load steps


def writable(path: str | Path, suffixes: tuple[str, ...]) -> Path:
    """Refuse a file that could not be written.

    Raises
    ------
    InputError
        When its ending is none of `suffixes`, it is a folder, or its folder is missing.

    """
    path = checked.path("path", path)
    if path.suffix not in suffixes:
        raise InputError(
            f"{path}: unknown format {path.suffix!r}; expected {' or '.join(suffixes)}"
        )
    if path.is_dir():
        raise InputError(f"{path} is a folder; expected a file")
    if not path.parent.is_dir():
        raise InputError(f"{path}: no folder {path.parent}; expected one that exists")
    return path


def existing(folder: Path) -> Path:
    """Refuse what is no folder.

    Raises
    ------
    InputError
        With what it is instead.

    """
    if not os.path.isdir(folder):
        what = "a file" if os.path.exists(folder) else "no such folder"
        raise InputError(f"{folder}: {what}; expected a result folder of `run`")
    return folder


def tolerance(tol: float, where: str = "tol") -> float:
    """Take a relative accuracy, between 0 and 1.

    Raises
    ------
    InputError
        For any other number.

    """
    if not isinstance(tol, Real) or isinstance(tol, bool) or not 0 < tol < 1:
        raise InputError(f"{where} = {shown(tol)}; expected a number between 0 and 1")
    return float(tol)


def solver_options(options: object, more: Mapping[str, Any] = {}) -> dict[str, Any]:
    """Join the options of a solver with those that are given as keywords.

    Raises
    ------
    InputError
        Unless they are a mapping from names to values, or None; and when one is among
        the keywords, too.

    """
    options = {} if options is None else options
    if not isinstance(options, Mapping) or not all(isinstance(k, str) for k in options):
        raise InputError(
            f"options = {shown(options)}; expected a dict from names to values, such "
            "as {'max_iter': 50}"
        )
    twice = sorted(options.keys() & more.keys())
    if twice:
        raise InputError(f"{twice[0]} is given twice: in `options` and as a keyword")
    return {**options, **more}


def drawn_scale(scale: float, where: str = "scale") -> float:
    """Take a factor of displacements in pictures.

    Raises
    ------
    InputError
        When it is no finite number of a usual size.

    """
    if not abs(scale) <= MOST_SCALE:  # a NaN, too
        raise InputError(
            f"{where} = {scale:g}; expected a number, at most {MOST_SCALE:g}"
        )
    return scale


def budget(seconds: float, where: str = "budget") -> float:
    """Take a number of seconds, 0 or more.

    Raises
    ------
    InputError
        For any other number.

    """
    if not checked.is_number(seconds) or not seconds >= 0:  # a NaN, too
        raise InputError(
            f"{where} = {shown(seconds)}; expected a number of seconds ≥ 0"
        )
    return seconds


def check_known(
    kind: str, names: Sequence[str], known: Sequence[str], where: str
) -> None:
    """Refuse names that are not known, such as of a format.

    Raises
    ------
    InputError
        With what would be right.

    """
    for name in names:
        if name not in known:
            raise unknown(kind, name, known, where=where)
