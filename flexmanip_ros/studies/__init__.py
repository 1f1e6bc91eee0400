"""Many runs of a scenario, and their scores."""
