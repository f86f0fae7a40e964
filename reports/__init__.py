"""Pure functions from records to text, tables and figures."""

from reports.compare.report import write_comparison
from reports.folder import write_report

__all__ = ["write_comparison", "write_report"]
