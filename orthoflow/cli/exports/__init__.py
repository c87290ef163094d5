"""What `orthoflow export` writes: the table of formats, their options, a module per family."""
