"""Clouds as files for other programs: what each point has, its colour, a writer per format."""
