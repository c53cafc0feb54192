"""Reconstructors, one file each."""

from srtomo_srtc.reconstructors.implicit import implicit

__all__ = ["implicit"]
