"""The office on the operator's page: maps read, fields drawn and planned, on the ground."""
