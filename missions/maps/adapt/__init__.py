"""ADAPT Standard: GeoTIFF or GeoParquet with a catalogue."""
