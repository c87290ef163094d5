"""Files of other programs: point files, images, GeoTIFF, and what orthoflow publishes."""
