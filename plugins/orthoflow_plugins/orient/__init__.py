"""Methods of the kind `orient`: exterior orientation of the photos."""
