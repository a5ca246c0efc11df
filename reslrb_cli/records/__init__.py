"""What a run writes down: its folder, manifest, metrics, checkpoints, images and parameters, and its clock readings.

`clock` needs Dr.Jit and `images` Mitsuba, the other modules neither; so nothing is imported here.
"""
