"""Methods of the kind `match`: matching points of photos with points on the walls."""
