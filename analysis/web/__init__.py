"""Flights on the operator's page: their list, report, and what they left (group `vrspray.web`)."""
