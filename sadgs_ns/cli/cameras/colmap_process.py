"""What COLMAP's process runs: it imports torch and nerfstudio from the first second on, while photos are read."""

from sadgs_ns.cli.cameras.reconstruct import begin_imports, make_model

__all__ = ["make_model"]

begin_imports()
