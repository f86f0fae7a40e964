"""Pure functions from records to text, tables and figures."""

from reports.compare.report import write_comparison, write_comparisons
from reports.folder import answer, figures, write_report

__all__ = ["answer", "figures", "write_comparison", "write_comparisons", "write_report"]
