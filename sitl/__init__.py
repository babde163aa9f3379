"""Instead of the flight: vehicle, sprayer and flight controller, simulated."""
