"""Name and version of this release, for what is written into files."""

# What pip calls it.
DISTRIBUTION = "orthoflow-tls"
__version__ = "0.2.0"
