"""Readers of files from other programs (images, GeoTIFF, point clouds), and writers of results."""
