"""Before the flight: field to mission."""
