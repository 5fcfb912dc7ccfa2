"""Global descriptors aggregated from local features."""

from hloc_reduce.confs.retrieval import confs

__all__ = ["confs"]
