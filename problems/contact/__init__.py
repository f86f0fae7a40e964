"""Contact of elastic bodies: which sides may touch, and the rows that say so."""
