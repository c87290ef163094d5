"""Methods of the kind `simulate`."""
