"""A mission file onto the vehicle, verified by reading back; MAVSDK only where it talks."""
