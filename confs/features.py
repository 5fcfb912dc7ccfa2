"""Local features by name, such as sift_sv64; see `hloc_reduce.confs.features`."""

from hloc_reduce.confs.features import RECOMMENDED, confs, get

__all__ = ["RECOMMENDED", "confs", "get"]
