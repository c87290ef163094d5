"""Hook of the plugin."""

from orthoflow.sdk import MethodSpec, hookimpl


@hookimpl
def orthoflow_methods() -> list[MethodSpec]:
    """Return the method."""
    return [
        MethodSpec(
            id="orient.poselib",
            target="orthoflow_poselib.method:OrientPoselib",
            summary="PoseLib's absolute pose, LO-RANSAC with refinement, photo by photo",
        ),
    ]
