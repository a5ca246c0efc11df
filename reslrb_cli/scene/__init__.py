"""Scenes: loading, contents, required features, recoverable parameters, and images to compare with."""
