"""Error against run time: what each method costs, and how fast the error of the average of its steps falls."""
