"""An orthoflow plugin: PoseLib orients the photos."""
