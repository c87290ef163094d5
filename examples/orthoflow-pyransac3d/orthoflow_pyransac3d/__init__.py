"""An orthoflow plugin: pyRANSAC-3D finds the planes."""
