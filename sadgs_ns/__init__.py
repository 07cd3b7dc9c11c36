"""Structure-aware densification for Gaussian splatting, as a nerfstudio method."""
