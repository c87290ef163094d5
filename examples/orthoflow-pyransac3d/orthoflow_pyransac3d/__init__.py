"""An orthoflow plugin: planes are found by pyRANSAC-3D."""
