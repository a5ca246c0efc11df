"""Files and records of a run: folder, manifest, metrics, checkpoints, images, parameters and timings.

Nothing is imported here, because `clock` needs Dr.Jit and `images` needs Mitsuba.
"""
