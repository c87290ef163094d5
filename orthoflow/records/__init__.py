"""The record of a run: writing run.h5 at the end, and reading it back."""
