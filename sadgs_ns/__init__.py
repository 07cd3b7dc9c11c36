"""Structure-aware densification for Gaussian splatting, as a nerfstudio method."""

from sadgs_ns.errors import refuse_deleted_working_directory

refuse_deleted_working_directory()
