"""The nerfstudio glue: model, pipeline, trainer and viewer panel of `ns-train sadgs`."""
