"""Methods of the kind `read`, which read input files."""
