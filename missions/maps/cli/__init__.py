"""`vrspray map`: what is in a map, what is wrong with it, and the flight map made of it."""
