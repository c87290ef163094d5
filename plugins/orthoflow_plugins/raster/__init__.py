"""Methods of the kind `raster`."""
