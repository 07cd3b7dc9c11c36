"""Readers and checks of captures: COLMAP, PLY, cameras and images."""

IMAGE_SUFFIXES = {".png", ".jpg", ".jpeg", ".jpe", ".jfif", ".webp", ".avif", ".tif", ".tiff", ".bmp"}
"""Suffixes of the formats of photos that training reads."""
