"""The version of this release, for whoever writes it into a file."""

__version__ = "0.1.0"
