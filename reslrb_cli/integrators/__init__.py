"""Integrators behind one interface: light tracers as Mitsuba plugins, stock baselines, and the gradient step."""
