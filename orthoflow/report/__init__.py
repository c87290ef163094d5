"""The report page: what came out and how good it is, in one file."""
