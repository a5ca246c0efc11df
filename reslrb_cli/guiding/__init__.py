"""Guided emission: recorded contributions for each starting cell of light paths, and tables learned from these
contributions.
"""
