"""Matchers by hloc's names."""

from hloc_reduce.confs.matchers import confs

__all__ = ["confs"]
