"""Clouds as files for other programs: point attributes and colours, and a writer per format."""
