"""Export of clouds for other programs: point attributes and colours, and a writer per format."""
