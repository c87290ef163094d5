"""Files of other programs: images, GeoTIFF, point clouds, and the files that a run publishes."""
