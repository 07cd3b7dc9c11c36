"""Reading and checking captures: COLMAP, PLY, cameras and images."""
