"""Methods of the kind `match`: points of photos found on the walls."""
