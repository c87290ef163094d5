"""The record format of orthoflow, which needs only h5py, numpy and pydantic."""
