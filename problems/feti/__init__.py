"""Total FETI: bodies torn into subdomains that multipliers glue together."""
