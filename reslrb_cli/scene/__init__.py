"""Scenes: loading, what they contain and need, the parameters that can be recovered, and images to compare with."""
