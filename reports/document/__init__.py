"""The report as data: sections, tables and figures, and numbers as text."""
