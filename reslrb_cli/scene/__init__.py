"""Scenes: loading, contents and needs, the parameters that can be recovered, and images to compare with."""
