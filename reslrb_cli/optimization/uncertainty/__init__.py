"""How certain the values are that a run ends with: their spread about the optimum, and a verdict on each parameter."""
