"""From a field's data to a prescription that the sprayer can fly."""
