"""Files of Gaussians: each module writes one format, and knows neither torch nor nerfstudio."""
