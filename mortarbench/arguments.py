"""Checks of arguments, performed before slow computations and imports."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from numbers import Real
from pathlib import Path
from typing import Any

from mortarbench.harness import checked
from mortarbench.harness.errors import InputError, shown, unknown

EXPORTS = (".npz", ".mat", ".parquet", ".qps")  #: suffixes of exported QPs
ARCHIVES = (".npz",)  #: suffix of a written answer
PICTURES = (".png", ".pdf", ".svg")  #: suffixes of pictures
FORMATS = ("html", "md", "tex", "csv", "parquet")  #: formats of a report
GATES = ("worse", "slower")  #: values allowed in the argument `fail_on` of `report`
MAX_SCALE = 1e9  #: largest absolute magnification of displacements in pictures
GRIDS = (".vtu", ".pvd")  #: suffixes of ParaView files: one state, or all steps


def check_output_file(path: str | Path, suffixes: tuple[str, ...]) -> Path:
    """Check that `path` is a valid name of an output file, and return the path.

    Raises
    ------
    InputError
        If the suffix is not in `suffixes`, `path` is a folder, or the folder that would
        contain the file is missing.

    """
    path = checked.path("path", path)
    if path.suffix not in suffixes:
        raise InputError(
            f"{path}: unknown format {path.suffix!r}; expected {' or '.join(suffixes)}"
        )
    if path.is_dir():
        raise InputError(f"{path} is a folder; expected a file")
    if not path.parent.is_dir():
        raise InputError(
            f"{path}: the folder {path.parent} does not exist; expected "
            "an existing folder"
        )
    return path


def check_result_folder(folder: Path) -> Path:
    """Check that a folder exists, and return its path.

    Raises
    ------
    InputError
        If there is no such folder, or `folder` is a file.

    """
    if not os.path.isdir(folder):
        what = "a file" if os.path.exists(folder) else "no such folder"
        raise InputError(f"{folder}: {what}; expected a result folder of `run`")
    return folder


def tolerance(tol: float, where: str = "tol") -> float:
    """Check a relative tolerance, and return the tolerance as a float.

    where : name of the argument in the error message

    Raises
    ------
    InputError
        If `tol` is not a number with 0 < tol < 1.

    """
    if not isinstance(tol, Real) or isinstance(tol, bool) or not 0 < tol < 1:
        raise InputError(f"{where} = {shown(tol)}; expected a number between 0 and 1")
    return float(tol)


def solver_options(options: object, more: Mapping[str, Any] = {}) -> dict[str, Any]:
    """Merge the options of a solver from a mapping and from keyword arguments.

    options : mapping from names to values, or None
    more : keyword arguments

    Raises
    ------
    InputError
        If `options` is neither None nor a mapping from names to values, or a name is in
        both `options` and `more`.

    """
    options = {} if options is None else options
    if not isinstance(options, Mapping) or not all(isinstance(k, str) for k in options):
        raise InputError(
            f"options = {shown(options)}; expected a dict that maps names to values, "
            f"such as {{'max_iter': 50}}"
        )
    twice = sorted(options.keys() & more.keys())
    if twice:
        raise InputError(
            f"option {twice[0]!r} is given twice: in `options` and as a keyword"
        )
    return {**options, **more}


def check_scale(scale: float, where: str = "scale") -> float:
    """Check the magnification of displacements in pictures, and return its value.

    where : name of the argument in the error message

    Raises
    ------
    InputError
        If `scale` is NaN or its absolute value exceeds `MAX_SCALE`.

    """
    if not abs(scale) <= MAX_SCALE:  # unlike `>`, this also rejects NaN
        raise InputError(
            f"{where} = {scale:g}; expected a number of magnitude at most {MAX_SCALE:g}"
        )
    return scale


def check_names(
    kind: str, names: Sequence[str], allowed: Sequence[str], where: str
) -> None:
    """Check that all names, for example names of formats, are allowed.

    kind : noun for the names in the error message, such as ``format``
    where : name of the argument in the error message

    Raises
    ------
    InputError
        If a name is not allowed; the message suggests the most similar allowed name or
        lists all of them.

    """
    for name in names:
        if name not in allowed:
            raise unknown(kind, name, allowed, where=where)
