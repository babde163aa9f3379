"""What measures, generates and checks the project; nothing of it is installed."""
