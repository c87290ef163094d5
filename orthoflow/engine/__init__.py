"""Plan, store and executors: turns cells into results."""
