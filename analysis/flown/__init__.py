"""A flown flight: its journal as arrays, and the volume that its executed changes stand for."""
