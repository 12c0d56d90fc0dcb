"""Everything that `evaluate` takes by name."""
