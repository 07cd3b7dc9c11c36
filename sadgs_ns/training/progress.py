"""Names under which `config.yml` of runs before version 1.1 finds these classes."""

from sadgs_ns.training.run.progress import ProgressTable

__all__ = ["ProgressTable"]
