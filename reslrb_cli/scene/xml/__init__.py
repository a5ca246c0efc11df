"""Scene files before Mitsuba makes objects of them: reading, mending, checks, and building."""
