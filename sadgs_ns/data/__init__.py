"""Readers and checks of captures: COLMAP, PLY, cameras and images."""

IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".jpe", ".jfif", ".webp", ".avif", ".tif", ".tiff", ".bmp"}
"""Suffixes of the formats of photos that training reads."""
SIDEWAYS = range(5, 9)
"""EXIF's orientations, of 1 to 8, of pixels whose width and height change places where they are upright."""
