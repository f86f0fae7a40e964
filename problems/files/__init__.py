"""QPs from files: formats, digests and two-sided rows."""
