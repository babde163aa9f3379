"""Mission files: QGroundControl's plan, QGC WPL 110, GeoJSON and KML."""
