"""Global descriptors aggregated from local features."""

confs: dict[str, dict] = {
    "vlad": {
        "output": "global-feats-vlad",
        "model": {"name": "vlad", "num_words": 64, "max_samples": 200_000},
    },
}
