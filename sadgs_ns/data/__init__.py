"""Readers and checks of captures: COLMAP, PLY, cameras and images."""
