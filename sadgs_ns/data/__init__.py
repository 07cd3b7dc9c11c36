"""Readers and checks of captures: COLMAP, PLY, cameras and images."""

IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".jpe", ".jfif", ".webp", ".avif", ".tif", ".tiff", ".bmp"}
"""Suffixes of the formats of photos that training reads."""
TURNED, SIDEWAYS = range(2, 9), range(5, 9)
"""EXIF's orientations of pixels that are not stored upright, and of those whose width and height change places."""
