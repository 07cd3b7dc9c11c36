"""Rasterization behind one door: Triton's or gsplat's kernels draw on CUDA, torch elsewhere."""
