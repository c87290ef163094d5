"""Workflow files: reading, checks, and expansion into cells."""
