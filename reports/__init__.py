"""Pure functions from records to text, tables and figures."""

from reports.compare.report import write_comparison, write_comparisons
from reports.folder import answer, write_report

__all__ = ["answer", "write_comparison", "write_comparisons", "write_report"]
