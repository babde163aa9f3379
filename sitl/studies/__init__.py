"""Studies that no command flies: the papers compared, sensitivity, limits, hard fields."""
