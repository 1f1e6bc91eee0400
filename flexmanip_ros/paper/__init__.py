"""Everything that reproduces the paper."""
