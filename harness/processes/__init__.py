"""The processes of a run: workers, what they say, what holds them."""
