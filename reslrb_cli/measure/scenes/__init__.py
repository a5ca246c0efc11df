"""Built-in scenes of measurements."""
