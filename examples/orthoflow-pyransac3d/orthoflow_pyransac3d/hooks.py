"""Hook of the plugin."""

from orthoflow.sdk import MethodSpec, hookimpl


@hookimpl
def orthoflow_methods() -> list[MethodSpec]:
    """Return the method."""
    return [
        MethodSpec(
            id="plane.pyransac3d",
            target="orthoflow_pyransac3d.method:PyRansac3d",
            summary="planes of pyRANSAC-3D, one after the other",
        ),
    ]
