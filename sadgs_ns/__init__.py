"""Structure-aware densification for Gaussian splatting, as a nerfstudio method."""

from sadgs_ns.errors import check_working_directory

check_working_directory()
