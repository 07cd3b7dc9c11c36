"""Rasterization has one entrance: gsplat and Triton kernels draw on CUDA, a torch splatter elsewhere."""
