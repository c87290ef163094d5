"""Readers of point files, block by block; `open_scan` chooses the reader for a file."""

from orthoflow.files.points.formats import FORMATS, open_scan
from orthoflow.files.points.scan_file import PointBlock, PointQuery, Scan, ScanFile

__all__ = ["FORMATS", "PointBlock", "PointQuery", "Scan", "ScanFile", "open_scan"]
