"""What a scene's files say, before Mitsuba makes objects of it: read, named, mended, checked, and built."""
