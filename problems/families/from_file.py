"""The family of QPs from files; see `problems.files.readers`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING

from harness import Family, InputError
from problems.files.file_digest import check_digest, digest, format_of

if TYPE_CHECKING:
    from harness import Case, Reference, Solution, Value


@dataclass(frozen=True)
class FromFile(Family):
    """Any QP from a file: npz, mat (ours or Maros-Mészáros), QPS text or Parquet.

    Text and mat files may be compressed: ``file:PATH.qps.gz``.
    The digest of the file's content is a parameter of the case, so that records say
    what was measured and a changed file is not taken for it.
    """

    name: str = "file"
    path_suffix: str = ""  #: all after ``file:`` is the path
    defaults: Mapping[str, Value] = field(
        default_factory=lambda: MappingProxyType({"path": "", "sha256": ""}), hash=False
    )
    forms: tuple[str, ...] = ("qp",)

    def complete(self, given: Mapping[str, Value]) -> Mapping[str, Value]:
        """Fill in the digest of the file's content."""
        params = {**self.defaults, **given}
        if params["path"] and "sha256" not in given:
            params["sha256"] = digest(Path(str(params["path"])))
        return params

    def check(self, params: Mapping[str, Value]) -> None:
        """Raise InputError unless there is such a file of a known format."""
        path = Path(str(params["path"]))
        if not params["path"]:
            raise InputError("file: path is missing; expected file:PATH")
        format_of(path)
        check_digest(params["path"], params["sha256"], digest(path))

    def build(
        self, form: str, params: Mapping[str, Value], reference: Reference
    ) -> Case:
        """Read the QP; its objective in the units of the file is the quantity value."""
        from harness import Case
        from problems.files.readers import read

        self.check(params)
        qp, scale, constant = read(Path(str(params["path"])))

        def quantities(s: Solution) -> dict[str, float]:
            return {"value": scale * qp.objective(s.x) + constant}

        return Case(
            qp=qp, recover=lambda s: s.x, quantities=quantities,
            scale=scale, constant=constant,
        )  # fmt: skip
