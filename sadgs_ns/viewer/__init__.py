"""Pictures of Gaussians, wavelengths and planned splits for the viewer, sadgs-inspect and the demo."""
