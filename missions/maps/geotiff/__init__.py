"""GeoTIFF, and DJI's package of it."""
