"""The configuration: one YAML file is one experiment. Knows no Mitsuba."""
