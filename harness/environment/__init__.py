"""Machine and software of a measurement: description and checks."""
