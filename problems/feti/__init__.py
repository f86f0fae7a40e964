"""Total FETI: bodies torn into subdomains, glued by multipliers."""
