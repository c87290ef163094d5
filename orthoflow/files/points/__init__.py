"""Scans as files of other programs, read block by block: `open_scan` gives the right reader."""

from orthoflow.files.points.blocks import PointBlock, ScanFile
from orthoflow.files.points.formats import FORMATS, open_scan

__all__ = ["FORMATS", "PointBlock", "ScanFile", "open_scan"]
