"""Global descriptors made of local features."""

confs = {
    "vlad": {
        "output": "global-feats-vlad",
        "model": {"name": "vlad", "num_words": 64, "max_samples": 200_000},
    },
}
