"""Name and version of this release, as they are written into files."""

# Name of the distribution on package indexes.
DISTRIBUTION = "orthoflow-tls"
__version__ = "0.2.0"
