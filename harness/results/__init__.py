"""Result folders: journal, faults, merging, and repeating stored measurements."""
