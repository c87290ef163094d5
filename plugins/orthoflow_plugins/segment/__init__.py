"""Methods of the kind `segment`."""
