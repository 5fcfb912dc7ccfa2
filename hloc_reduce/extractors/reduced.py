"""Any extractor followed by a frozen projection of its descriptors."""

from .. import extractors, projections
from ..base_model import BaseModel, dynamic_load
from ..cli import InputError


class Reduced(BaseModel):
    """The features of `base` with descriptors projected to fewer dimensions.

    `base` is the configuration of an extractor, `projection` the name of a projection that ships
    or the path of one.
    """

    default_conf = {"base": {"name": "dog"}, "projection": "sift_sv64"}
    required_inputs = ("image",)

    def _init(self, conf: dict) -> None:
        self.base = dynamic_load(extractors, conf["base"]["name"])(conf["base"])
        self.project = projections.load(conf["projection"])
        trained_on = self.project.metadata.get("descriptor")
        described = self.base.conf.get("descriptor", trained_on)
        if trained_on not in (None, described):
            raise InputError(
                f"The projection {conf['projection']} is for {trained_on}, not for {described}."
            )

    @property
    def detection_noise(self) -> float:
        """The standard deviation of the keypoints in pixels, as the base extractor has it."""
        return self.base.detection_noise

    def _forward(self, data: dict) -> dict:
        features = self.base(data)
        descriptors = features["descriptors"][0].T
        if descriptors.shape[1] != self.project.sizes[0]:
            raise InputError(
                f"The projection {self.conf['projection']} is for {self.project.sizes[0]}-D "
                f"descriptors, those of {self.conf['base']['name']} have {descriptors.shape[1]}."
            )
        return {**features, "descriptors": self.project(descriptors).T[None]}
