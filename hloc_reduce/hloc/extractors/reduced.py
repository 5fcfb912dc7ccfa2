"""hloc's extractor `reduced`: any extractor and a frozen projection of its descriptors."""

from hloc.utils.base_model import BaseModel

from hloc_reduce.extractors import load


class Reduced(BaseModel):
    """`hloc_reduce.extractors.reduced` for hloc; the same configuration."""

    required_inputs = ["image"]

    def _init(self, conf: dict) -> None:
        self.model = load({**conf, "name": "reduced"})

    @property
    def detection_noise(self) -> float:
        """The standard deviation of the keypoints in pixels, which hloc stores with them."""
        return self.model.detection_noise

    def _forward(self, data: dict) -> dict:
        features = {key: value for key, value in self.model(data).items() if key != "blur"}
        # hloc would store float32 as float16, which has no fractions of pixels above 1024
        return {**features, "keypoints": features["keypoints"].double()}
