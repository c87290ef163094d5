"""Name and version of this release, as written into files."""

# Name of the distribution on package indexes.
DISTRIBUTION = "orthoflow-tls"
__version__ = "0.2.0"
