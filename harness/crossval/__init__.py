"""Cross-validation: comparison of answers with each other and with references."""
