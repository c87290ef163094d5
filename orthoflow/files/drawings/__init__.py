"""Drawings of walls and rooms: sheets to scale, CAD files and vectors."""
