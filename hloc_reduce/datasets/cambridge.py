"""Scenes of Cambridge Landmarks, with the SIFT models that hloc's pipeline downloads."""

from pathlib import Path
from typing import ClassVar

from ..utils import colmap
from . import DAY_THRESHOLDS
from .scenes import Scene


class Cambridge(Scene):
    """A scene such as cambridge/ShopFacade, with seq1/frame00001.png and so on.

    Its models are in CambridgeLandmarks_Colmap_Retriangulated_1024px/ShopFacade: `empty_all` has
    the poses of all images, and `model_train` the map. Their cameras are of smaller photos.
    """

    results: ClassVar[str] = "Cambridge"
    models: ClassVar[str] = "CambridgeLandmarks_Colmap_Retriangulated_1024px"
    all_images: ClassVar[str] = "empty_all"
    query_list: ClassVar[str] = "list_query.txt"
    source: ClassVar[str] = (
        "The models come from hloc/pipelines/Cambridge/README.md of "
        "https://github.com/cvg/Hierarchical-Localization."
    )

    def map_names(self) -> list[str]:
        """Read the names of the map images."""
        model = colmap.read_model(self.reference(Path()))
        return sorted(image.name for image in model.images.values())

    def reference(self, folder: Path) -> Path:
        """Return the model of the map images; nothing is written."""
        return colmap.find_model(self.folder(self.root) / "model_train")

    def thresholds(self, query_list: str) -> tuple[tuple[float, float], ...]:
        """Return the thresholds of outdoor places."""
        return DAY_THRESHOLDS
