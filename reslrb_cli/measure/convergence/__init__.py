"""Error against run time: the cost of each method, and how fast the error falls when steps are averaged."""
