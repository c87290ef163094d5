"""Drawings of walls and rooms: sheets in scale, CAD files and vectors."""
