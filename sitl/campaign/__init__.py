"""Many simulated flights over settings: `vrspray campaign`, on one machine or on a cluster."""
