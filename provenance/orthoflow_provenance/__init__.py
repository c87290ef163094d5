"""The record format of orthoflow. This package needs only h5py, NumPy and Pydantic."""
