"""Methods of the kind `orient`: where the photos were taken."""
