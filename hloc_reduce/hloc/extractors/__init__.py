"""Modules that hloc imports as its own, under hloc.extractors; see `hloc_reduce.register`."""
