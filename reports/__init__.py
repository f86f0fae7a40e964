"""Reports from measurements: text, tables and figures."""
