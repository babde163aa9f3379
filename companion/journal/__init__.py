"""The journal of a flight: one GeoPackage file."""
