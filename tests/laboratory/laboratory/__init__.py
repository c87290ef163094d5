"""Methods that compute nothing, with the ports of the real ones."""
