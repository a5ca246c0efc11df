"""Choice of libLLVM and of the Mitsuba variant, both before anything is traced."""
