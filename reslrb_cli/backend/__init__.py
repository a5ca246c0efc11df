"""The choice of libLLVM and of the Mitsuba variant, both made before anything is traced."""
