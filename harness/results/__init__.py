"""Result folders: journal, faults, merging, and repetition of stored measurements."""
