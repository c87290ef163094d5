"""Small methods that really run, in milliseconds."""
