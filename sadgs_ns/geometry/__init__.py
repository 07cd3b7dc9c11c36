"""What is decided from a capture's geometry: near plane, camera paths, limits on scales, stereo depth, outliers."""
