"""Scans as files of other programs, read block by block: `open_scan` chooses the reader."""

from orthoflow.files.points.blocks import PointBlock, Scan, ScanFile
from orthoflow.files.points.formats import FORMATS, open_scan

__all__ = ["FORMATS", "PointBlock", "Scan", "ScanFile", "open_scan"]
