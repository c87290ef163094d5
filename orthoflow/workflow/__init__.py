"""The workflow document: reading it, checking it, and expanding it into cells."""
