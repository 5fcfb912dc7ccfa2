"""Any extractor followed by a frozen projection of its descriptors."""

from .. import projections
from ..utils.cli import InputError
from . import Extractor, is_rotation_invariant, load


class Reduced(Extractor):
    """The features of `base` with descriptors projected to fewer dimensions.

    `base` is the configuration of an extractor of this project or of an installed hloc.
    `projection` is the name of a shipped projection, the path of another one, or None.
    """

    default_conf = {"base": {"name": "dog"}, "projection": None}

    def _init(self, conf: dict) -> None:
        self.extractor = load(conf["base"])
        self.detect, self.dim = self.base.detect, self.base.dim
        self.detection_noise = self.base.detection_noise
        self.detection_blocks = self.base.detection_blocks
        self.gpu_images, self.cpu_images = self.base.gpu_images, self.base.cpu_images
        self.rotation_invariant = self.base.rotation_invariant
        self.project = None
        if conf["projection"] is None:
            return
        self.project = projections.load(conf["projection"])
        trained_on = self.project.metadata.get("descriptor", self.base.descriptor)
        if trained_on != self.base.descriptor:
            raise InputError(
                f"The projection {conf['projection']} is for {trained_on}, not for "
                f"{self.base.descriptor}."
            )
        self.dim = self.project.dim

    @classmethod
    def is_rotation_invariant(cls, conf: dict) -> bool:
        """Tell whether `base` is."""
        return is_rotation_invariant({**cls.default_conf, **conf}["base"])

    @property
    def base(self) -> Extractor:
        """The extractor whose descriptors are projected."""
        return self.extractor

    @property
    def detection(self) -> dict:
        """What determines the keypoints."""
        return self.base.detection

    def _forward(self, data: dict) -> dict:
        return self.reduce(self.base(data))

    def reduce(self, features: dict) -> dict:
        """Project the descriptors of features of `base`."""
        if self.project is None:
            return features
        descriptors = features["descriptors"][0].T
        if descriptors.shape[1] != self.project.sizes[0]:
            raise InputError(
                f"The projection {self.conf['projection']} is for {self.project.sizes[0]}-D "
                f"descriptors, those of {self.conf['base']['name']} have {descriptors.shape[1]}."
            )
        return {**features, "descriptors": self.project(descriptors).T[None]}
