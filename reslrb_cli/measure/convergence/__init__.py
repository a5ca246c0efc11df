"""Error against run time: the cost of each method, and how fast the error of the average of its steps falls."""
