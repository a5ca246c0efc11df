"""Processing of scene files before Mitsuba makes objects: reading, mending, checks, and building."""
