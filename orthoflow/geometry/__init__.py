"""Planes, directions and raster frames: pure array arithmetic, without files or clocks."""

from orthoflow.geometry.directions import UpDirection, basis_from_up, up_vector
from orthoflow.geometry.frames import WallFrame, frame_over, wall_axes
from orthoflow.geometry.levels import eight_bits
from orthoflow.geometry.planes import Plane, angle_between_deg, omega_phi_deg, plane_through

__all__ = [
    "Plane",
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
