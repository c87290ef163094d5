"""Methods of the kind `orient`, which compute the exterior orientation of photos."""
