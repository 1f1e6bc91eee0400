"""The nodes: each converts, makes one call of the core and publishes."""
