"""Family `file`, QPs from files; see `problems.files.readers`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from mortarbench.harness import Family, InputError
from mortarbench.harness.files.datafile import content_digest
from mortarbench.harness.names import split_row
from mortarbench.problems.files.file_digest import check_digest, format_of

if TYPE_CHECKING:
    from mortarbench.harness import Case, Reference, Solution, Value


class FromFile(Family):
    """QPs from files: npz, mat, QPS, Parquet, or JSON of Clarabel.

    ``file:PATH.parquet#ROW`` is one problem of a Parquet file, counted from 1. Text and
    mat files may be compressed: ``file:PATH.qps.gz``. The digest of the file is a
    parameter of the case. The digest identifies the measured QP in records, and a
    changed file defines a different case.
    """

    name = "file"
    path_suffix = ""  #: empty, because everything after ``file:`` is the path
    defaults: Mapping[str, Value] = MappingProxyType({"path": "", "sha256": ""})
    forms = ("qp",)

    def complete(self, given: Mapping[str, Value]) -> Mapping[str, Value]:
        """Return all keys, including the digest of the file."""
        params = {**self.defaults, **given}
        if params["path"] and "sha256" not in given:
            path, _ = split_row(str(params["path"]))
            params["sha256"] = content_digest(Path(path))
        return params

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless the file exists, in a known format and unchanged."""
        if not params["path"]:
            raise InputError(
                f"{self.name}: path is missing; expected {self.name}:PATH"
                f"{self.path_suffix}"
            )
        if not self.path_suffix:
            format_of(Path(split_row(str(params["path"]))[0]))
        self._located(params)

    def problems_in(self, path: str) -> list[str]:
        """Return the paths of all problems in a file; Parquet files may have several.

        Raises
        ------
        InputError
            If the path is that of a Parquet file that cannot be read.

        """
        if not path.lower().endswith(".parquet"):
            return [path]
        from mortarbench.harness.files.parquetfile import count_problems

        count = count_problems(self._located(self.complete({"path": path})))
        return [path] if count == 1 else [f"{path}#{i + 1}" for i in range(count)]

    def _located(self, params: Mapping[str, Value]) -> Path:
        """Check the digest of the file, and return its path."""
        path = Path(split_row(str(params["path"]))[0])
        check_digest(str(path), params["sha256"], content_digest(path))
        return path

    def build(
        self, form: str, params: Mapping[str, Value], reference: Reference
    ) -> Case:
        """Return the case; its quantity `value` is the objective of the file."""
        from mortarbench.harness import Case
        from mortarbench.problems.files.readers import read

        _, row = split_row(str(params["path"]))
        qp, scale, constant, remarks = read(self._located(params), row)

        def quantities(s: Solution) -> dict[str, float]:
            return {"value": scale * qp.objective(s.x) + constant}

        return Case(
            qp=qp,
            recover=lambda s: s.x,
            quantities=quantities,
            scale=scale,
            constant=constant,
            remarks=remarks,
        )
