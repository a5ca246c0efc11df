"""From a picture to the surface whose caustic shows it: optimal transport, rays and heights."""
