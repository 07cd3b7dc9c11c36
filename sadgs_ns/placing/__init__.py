"""From photos to the poses of their cameras, with pycolmap."""
