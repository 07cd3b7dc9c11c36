"""A run from its start to its end: trainer, plan, checkpoints, resuming, processes and progress."""
