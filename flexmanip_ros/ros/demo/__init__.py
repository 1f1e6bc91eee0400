"""The demonstration: nodes in one process, a bag, a picture, a comparison with the replay."""
