"""The nodes: each converts, makes one core call and publishes."""
