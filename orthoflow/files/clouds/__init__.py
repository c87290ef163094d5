"""Clouds as files for other programs: fields and colours of each point, a writer per format."""
