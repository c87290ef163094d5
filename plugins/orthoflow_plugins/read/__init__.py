"""Methods of the kind `read`."""
