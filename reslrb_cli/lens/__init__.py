"""Computation of a surface whose caustic shows a given picture: optimal transport, rays and heights."""
