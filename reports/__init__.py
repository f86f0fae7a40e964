"""Pure functions from records to text, tables and figures."""

from reports.folder import write_report

__all__ = ["write_report"]
