"""Methods of the kind `inspect`."""
