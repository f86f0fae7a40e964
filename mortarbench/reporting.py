"""The report on a result folder, or on what changed between two."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from harness.checked import positive
from harness.files.durable import full_disk_told
from harness.record import VERIFIED_FACTOR
from mortarbench.arguments import FORMATS, check_formats
from mortarbench.registries import Registries


@dataclass(frozen=True, kw_only=True)
class Report:
    """The files of a report."""

    files: tuple[Path, ...]
    said: tuple[str, ...] = ()  #: the answer in a few lines, where two are compared

    @property
    def page(self) -> Path | None:
        """The HTML page, if it was asked for."""
        return next((file for file in self.files if file.suffix == ".html"), None)

    def __repr__(self) -> str:
        return "\n".join([*self.said, str(self.page or f"{len(self.files)} files")])

    def _repr_html_(self) -> str:
        lines = "".join(f"<p>{escape(line)}</p>" for line in self.said)
        if self.page is None:
            return f"{lines}<p>{len(self.files)} files</p>"
        page = escape(str(self.page), quote=True)
        return f"{lines}<p><a href='{page}'>{page}</a></p>"


def report(
    folder: str | Path,
    other: str | Path | None = None,
    *,
    formats: Sequence[str] = FORMATS,
    factor: float = VERIFIED_FACTOR,
    registries: Registries | None = None,
) -> Report:
    """Write DIR/report, or what changed from `folder` to `other` into the latter.

    Parameters
    ----------
    formats : of html, md, tex, csv, parquet
    factor : verified means every residual within factor·tol
    registries : whose way to report is used, instead of ours

    Raises
    ------
    InputError
        When a folder holds no measurements, or a format or the factor is none.

    """
    check_formats(formats, "formats")
    factor = positive("factor", factor)
    before = Path(folder)
    if other is None:
        write = (registries or Registries()).report
        with full_disk_told(before):
            return Report(files=tuple(write(before, formats, factor=factor)))
    from reports import write_comparison

    after = Path(other)
    with full_disk_told(after):
        said, files = write_comparison(before, after, formats, factor)
    return Report(files=tuple(files), said=tuple(said))
