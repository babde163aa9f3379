"""Journals in the office: read as a whole, shown, recovered, and salvaged where damaged."""
