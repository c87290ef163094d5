"""Files of other programs: images, GeoTIFF, point clouds, and what a run publishes for people."""
