"""Matchers, by hloc's names."""


def _ratio(threshold: float) -> dict:
    return {
        "output": f"matches-NN-mutual-ratio{threshold:g}".replace("0.", "."),
        "model": {"name": "nearest_neighbor", "ratio_threshold": threshold},
    }


confs: dict[str, dict] = {
    "NN-ratio": _ratio(0.8),
    "NN-ratio85": _ratio(0.85),
    "NN-ratio90": _ratio(0.9),
    "NN-ratio95": _ratio(0.95),
    "NN-mutual": {
        "output": "matches-NN-mutual",
        "model": {"name": "nearest_neighbor"},
    },
    "adalam": {"output": "matches-adalam", "model": {"name": "adalam"}},
}
