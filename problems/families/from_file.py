"""Family `file`, QPs from files; see `problems.files.readers`."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, ClassVar

from mortarbench.harness import Case, Family, Reference, Solution
from mortarbench.harness.files.datafile import content_digest
from mortarbench.harness.keys import DERIVED
from mortarbench.harness.names import split_row
from mortarbench.problems.files.file_digest import check_digest, format_of


@dataclass(frozen=True, kw_only=True)
class FromFile(Family):
    """QPs from files: npz, mat, QPS or Parquet.

    ``file:PATH.parquet#ROW`` is one problem of a Parquet file, counted from 1. Text and
    mat files may be compressed: ``file:PATH.qps.gz``. The digest of the file is a key
    of the case. The digest identifies the measured QP in records, and a changed file
    defines a different case.
    """

    forms: ClassVar = ("qp",)
    path_suffix: ClassVar = ""  #: empty: everything after ``file:`` is the path

    path: Annotated[str, "path of the file"] = ""
    sha256: Annotated[str, "digest of the file"] = DERIVED

    def __post_init__(self) -> None:
        """Compute the digest; check that the file exists, in a known format."""
        super().__post_init__()
        if not self.path:
            return  # the family of the registry, which has no file
        path = Path(split_row(self.path)[0])
        if self.sha256 is None:
            self.derive(sha256=content_digest(path))
        if not self.path_suffix:
            format_of(path)
        self.located()

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

        count = count_problems(replace(self, path=path).located())
        return [path] if count == 1 else [f"{path}#{i + 1}" for i in range(count)]

    def located(self) -> Path:
        """Check the digest of the file, and return its path."""
        path = Path(split_row(self.path)[0])
        check_digest(str(path), self.sha256, content_digest(path))
        return path

    def build(self, form: str, reference: Reference) -> Case:
        """Return the case; its quantity `value` is the objective of the file."""
        from mortarbench.problems.files.readers import read

        _, row = split_row(self.path)
        qp, scale, constant, remarks = read(self.located(), row)

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
