"""What is read and written: texts, arrays, QPs in several formats."""
