"""ISOXML 3 and 4, the task data of ISO 11783-10."""
