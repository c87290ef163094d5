"""An orthoflow plugin: photos are oriented by PoseLib."""
