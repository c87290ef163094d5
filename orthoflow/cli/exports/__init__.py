"""The writers of `orthoflow export`: table of formats, options, and a module per family."""
