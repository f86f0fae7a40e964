"""The report on a result folder, or on what changed between two."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from harness.checked import positive
from harness.errors import InputError
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
    pool_forms: bool = False,
    registries: Registries | None = None,
) -> Report:
    """Write DIR/report, or what changed from `folder` to `other` into the latter.

    Parameters
    ----------
    formats : of html, md, tex, csv, parquet
    factor : verified means every residual within factor·tol
    pool_forms : means, ranks and profiles compare the cases of all forms together, not
        form by form; a form that a solver declines is unsolved by it
    registries : whose way to report is used, instead of ours

    Raises
    ------
    InputError
        When a folder holds no measurements, a format or the factor is none, or forms
        are to be pooled in a comparison of two folders.

    """
    check_formats(formats, "formats")
    factor = positive("factor", factor)
    before = Path(folder)
    if other is None:
        write = (registries or Registries()).report
        with full_disk_told(before):
            files = write(before, formats, factor=factor, pool_forms=pool_forms)
            return Report(files=tuple(files))
    if pool_forms:
        raise InputError(
            "forms are pooled in the report on one folder (--pool-forms), not in a "
            "comparison of two, which pairs equal cases; leave one of them out"
        )
    from reports import write_comparison

    after = Path(other)
    with full_disk_told(after):
        said, changed = write_comparison(before, after, formats, factor)
    return Report(files=tuple(changed), said=tuple(said))
