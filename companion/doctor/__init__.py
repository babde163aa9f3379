"""What must hold before a flight: checks on facts, and the edges that gather the facts."""
