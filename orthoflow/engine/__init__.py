"""Planning and execution of runs, and the store of their results."""
