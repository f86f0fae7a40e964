"""What an answer is worth: measured residuals, verdicts, certificates."""
