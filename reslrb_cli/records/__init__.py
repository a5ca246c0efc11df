"""What a run writes down: its folder, manifest, metrics, checkpoints, images and parameters, and its clock readings.

`clock`, `images` and `parameters` need Mitsuba, the other modules do not; so nothing is imported here.
"""
