"""The writers of `orthoflow export`, with the table of formats and the options."""
