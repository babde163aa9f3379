"""Prescription files become `core.prescription.Prescription`; one format a file."""
