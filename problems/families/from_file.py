"""Family `file`, QPs from files; see `problems.files.readers`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from mortarbench.harness import Family, InputError
from mortarbench.harness.files.copies import Copies, content_digest
from mortarbench.harness.names import split_row
from mortarbench.harness.plugin import SourceFile
from mortarbench.problems.files.file_digest import check_digest, format_of

if TYPE_CHECKING:
    from mortarbench.harness import Case, Reference, Solution, Value


class FromFile(Family):
    """QPs from files: npz, mat, QPS, Parquet, or JSON of Clarabel.

    ``file:PATH.parquet#ROW`` is one problem of a Parquet file, counted from 1. Text and
    mat files may be compressed: ``file:PATH.qps.gz``. The digest of the file is a
    parameter of the case. The digest identifies the measured QP in records, and a
    changed file defines a different case.

    copies : copies of files in a result folder; None to read files from their original
        paths
    """

    name = "file"
    path_suffix = ""  #: empty, because everything after ``file:`` is the path
    defaults: Mapping[str, Value] = MappingProxyType({"path": "", "sha256": ""})
    forms = ("qp",)

    def __init__(self, copies: Copies | None = None) -> None:
        self.copies = copies

    def complete(self, given: Mapping[str, Value]) -> Mapping[str, Value]:
        """Return all keys, including the digest of the file."""
        params = {**self.defaults, **given}
        if params["path"] and "sha256" not in given:
            path, _ = split_row(str(params["path"]))
            if self.copies is None:
                params["sha256"] = content_digest(Path(path))
            else:
                params["sha256"] = self.copies.digest(path)
        return params

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless the file exists, in a known format and unchanged."""
        if not params["path"]:
            raise InputError(
                f"{self.name}: path is missing; expected {self.name}:PATH"
                f"{self.path_suffix}"
            )
        self._located(params)

    def source_file(self, params: Mapping[str, Value]) -> SourceFile:
        """Return the path of the file, the digest of its content, and its suffix."""
        path, _ = split_row(str(params["path"]))
        sha256, suffix = str(params["sha256"]), format_of(Path(path))
        if path.lower().endswith(".gz"):
            suffix += ".gz"
        return SourceFile(path=path, sha256=sha256, suffix=suffix)

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

    def with_copies(self, folder: Path) -> FromFile:
        """Return the family that reads the copies of a result folder."""
        return type(self)(Copies(folder))

    def copied_paths(self) -> list[str]:
        """Return the original paths of the files with copies in the result folder."""
        return [] if self.copies is None else self.copies.paths()

    def _located(self, params: Mapping[str, Value]) -> Path:
        """Return the path of the file, or of a copy, with the digest in `params`."""
        source = self.source_file(params)
        if self.copies is not None:
            return self.copies.locate(source)
        path = Path(source.path)
        check_digest(source.path, source.sha256, content_digest(path))
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
