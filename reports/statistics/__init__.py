"""Statistics: intervals, bootstraps, censored times, and profiles."""
