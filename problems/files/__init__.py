"""QPs from files: formats, content by digest, two-sided rows."""
