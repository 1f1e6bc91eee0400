"""The nodes: each converts a message, makes one call of the core and publishes."""
