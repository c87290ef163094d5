"""Methods of the kind `inspect`, which measure the errors of products."""
