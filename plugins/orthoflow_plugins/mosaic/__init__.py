"""Methods of the kind `mosaic`."""
