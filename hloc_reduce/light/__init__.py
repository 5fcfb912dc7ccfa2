"""Features, retrieval and matching in NumPy, for machines without torch."""
