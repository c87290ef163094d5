"""What the plugin announces."""

from orthoflow.sdk import MethodSpec, hookimpl


@hookimpl
def orthoflow_methods() -> list[MethodSpec]:
    """Give the one method."""
    return [
        MethodSpec(
            id="plane.pyransac3d",
            target="orthoflow_pyransac3d.method:PyRansac3d",
            summary="planes of pyRANSAC-3D, one after the other",
        ),
    ]
