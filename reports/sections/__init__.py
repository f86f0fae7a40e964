"""The sections of a report, one per module, and the cells that they share."""
