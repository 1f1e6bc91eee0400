"""From messages to samples on one clock."""
