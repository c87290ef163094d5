"""The conformance suite that every method passes, ours and a stranger's."""
