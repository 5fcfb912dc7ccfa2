"""hloc's matcher `reduced_lightglue`: LightGlue for projected descriptors."""

from hloc.utils.base_model import BaseModel

from hloc_reduce.matchers import load


class ReducedLightGlue(BaseModel):
    """`hloc_reduce.matchers.lightglue` for hloc; the same configuration."""

    required_inputs = [
        f"{key}{i}" for i in (0, 1) for key in ("keypoints", "descriptors", "image_size")
    ]

    def _init(self, conf: dict) -> None:
        self.model = load({**conf, "name": "lightglue"})

    def _forward(self, data: dict) -> dict:
        return self.model({key: data[key] for key in self.required_inputs})
