"""Reports: reading records, drawing plots, and writing the HTML page of a run."""
