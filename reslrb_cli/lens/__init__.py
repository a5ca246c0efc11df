"""From a picture to the surface whose caustic shows it: optimal transport (`transport.py`), rays and heights
(`surface.py`).
"""
