"""The version of the package: a file of its own, which everything may know."""

__version__ = "0.1.0"
