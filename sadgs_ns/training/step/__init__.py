"""A training step and what it reads: views, images, structure tensors, optimizers and CUDA graphs."""
