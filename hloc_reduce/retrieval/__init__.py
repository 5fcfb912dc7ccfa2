"""Retrieval: global descriptors of images, and which images they find."""
