"""Reports from records: text, tables and figures."""

from mortarbench.reports.compare.report import write_comparison, write_comparisons
from mortarbench.reports.folder import answer, figures, write_report

__all__ = ["answer", "figures", "write_comparison", "write_comparisons", "write_report"]
