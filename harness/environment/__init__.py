"""Machine and software of a measurement: description, checks and noise floor."""
