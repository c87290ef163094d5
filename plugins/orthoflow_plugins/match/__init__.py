"""Methods of the kind `match`, which match points of photos with points on the walls."""
