"""The record format of orthoflow: h5py and numpy only, readable without the program itself."""
