"""The record format of orthoflow, readable without the program: h5py, numpy, pydantic."""
