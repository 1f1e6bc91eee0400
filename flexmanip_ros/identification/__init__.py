"""Recursive and batch predictor-based subspace identification."""
