"""Detection of curved surfaces: cylinders and cones."""
