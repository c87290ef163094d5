"""Methods of the kind `plane`."""
