"""Methods of the kind `colour`."""
