"""Finished runs: writing the record, and the read API."""
