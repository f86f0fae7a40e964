"""QPs of a contact problem: primal and dual forms, for every load step."""
