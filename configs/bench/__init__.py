"""Benchmark protocols, installed as `sadgs_ns.configs.bench`."""
