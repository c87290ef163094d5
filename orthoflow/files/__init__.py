"""Readers of images, GeoTIFFs and point clouds from other programs, and writers of results."""
