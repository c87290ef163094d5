"""Methods of the kind `ortho`."""
