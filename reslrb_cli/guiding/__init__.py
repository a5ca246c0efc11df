"""Guided emission: contributions of light paths by their starting cells, and tables learned from them."""
