"""Methods of the kind `register`."""
