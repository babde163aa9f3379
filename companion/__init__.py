"""What runs on board, beside the flight controller."""
