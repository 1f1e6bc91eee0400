"""A controller that uses the payload estimate: joint hold and vibration damping."""
