"""Presets of the methods, installed as `sadgs_ns.configs`."""
