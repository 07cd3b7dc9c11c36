"""What COLMAP's process runs: it imports torch and nerfstudio from the first second on, while photos are read."""

from sadgs_ns.placing.reconstruct import begin_imports, make_model  # noqa: F401 - `colmap.py` starts it here

begin_imports()
