"""Integrators behind one interface: our light tracers as Mitsuba plugins, stock baselines, and the gradient step."""
