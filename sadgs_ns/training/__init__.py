"""The nerfstudio glue: model, pipeline, trainer and viewer panel of `ns-train sadgs`."""

from sadgs_ns.errors import print_uncaught_errors_as_sentences
from sadgs_ns.programs import put_ffmpeg_into_path

print_uncaught_errors_as_sentences()
put_ffmpeg_into_path()
