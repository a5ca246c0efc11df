"""From a picture to a surface that throws it: transport of light (`transport.py`), rays and heights (`surface.py`)."""
