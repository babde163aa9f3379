"""CSV of points or of polygons."""
