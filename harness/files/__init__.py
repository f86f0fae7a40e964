"""Reading and writing of files: texts, arrays, and QPs in several formats."""
