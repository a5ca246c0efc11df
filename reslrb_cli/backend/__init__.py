"""Choice of libLLVM and of the Mitsuba variant, before any tracing."""
