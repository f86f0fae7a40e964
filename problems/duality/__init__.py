"""The QPs of a contact problem: its primal, its duals, and its load steps."""
