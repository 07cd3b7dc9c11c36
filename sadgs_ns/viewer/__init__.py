"""What the viewer, sadgs-inspect and the demo show of Gaussians, wavelengths and planned splits."""
