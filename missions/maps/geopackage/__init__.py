"""GeoPackage, an SQLite database of layers."""
