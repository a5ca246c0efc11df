"""Guided emission: contributions of light paths by the cell that they start in, and tables learned from them."""
