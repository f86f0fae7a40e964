"""Verification of answers: residuals, verdicts, proven optima, certificates."""
