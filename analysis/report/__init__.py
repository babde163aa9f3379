"""The report of a flight: one page, every number as JSON, figures, the legal record."""
