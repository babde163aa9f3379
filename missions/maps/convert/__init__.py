"""Writing maps: the registry of writers, and what formats need of one another."""
