"""`sadgs-process`: from photos or a video to a scene for training."""
