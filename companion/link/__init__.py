"""MAVLink: bytes to our types and back, transports, component behaviour."""
