"""`sadgs-process`: photos or a video → a COLMAP scene."""
