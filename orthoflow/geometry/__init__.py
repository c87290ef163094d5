"""Geometry of planes, cameras, rasters and simulated scenes: pure array arithmetic."""

from orthoflow.geometry.bends import Bend, ConeBend, CylinderBend, SphereBend
from orthoflow.geometry.frames import (
    Plane,
    UpDirection,
    WallFrame,
    angle_between_deg,
    basis_from_up,
    frame_over,
    omega_phi_deg,
    plane_through,
    up_vector,
    wall_axes,
)
from orthoflow.geometry.levels import eight_bits
from orthoflow.geometry.surfaces import Cone, CurvedShape, Cylinder, Sphere

__all__ = [
    "Bend",
    "Cone",
    "ConeBend",
    "CurvedShape",
    "Cylinder",
    "CylinderBend",
    "Plane",
    "Sphere",
    "SphereBend",
    "UpDirection",
    "WallFrame",
    "angle_between_deg",
    "basis_from_up",
    "eight_bits",
    "frame_over",
    "omega_phi_deg",
    "plane_through",
    "up_vector",
    "wall_axes",
]
