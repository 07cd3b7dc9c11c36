"""Rasterization: one entrance, gsplat and Triton kernels on CUDA, a torch splatter elsewhere."""
