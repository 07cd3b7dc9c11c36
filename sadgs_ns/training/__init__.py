"""The nerfstudio glue: model, pipeline, trainer and viewer panel of `ns-train sadgs`."""

from sadgs_ns.errors import print_uncaught_errors_as_sentences

print_uncaught_errors_as_sentences()
