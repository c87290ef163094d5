"""Workflow files: reading, checking, and expansion into cells."""
