"""State-space models: subspace identification, its maximum-likelihood refinement, and models of every configuration."""
