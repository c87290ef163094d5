"""Name and version of this release, for whoever writes them into a file."""

# What pip calls it.
DISTRIBUTION = "orthoflow-tls"
__version__ = "0.2.0"
