"""The configuration: one YAML file describes one experiment. Does not import Mitsuba."""
