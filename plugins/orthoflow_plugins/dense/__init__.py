"""Methods of the kind `dense`."""
