"""Scenes of 7Scenes, with the SIFT models that hloc's pipeline downloads."""

from typing import ClassVar

from .scenes import Scene


class SevenScenes(Scene):
    """A scene such as 7scenes/chess, with seq-01/frame-000000.color.png and so on.

    Its model, with the poses of the queries, is 7scenes_sfm_triangulated/chess/triangulated.
    """

    results: ClassVar[str] = "7Scenes"
    models: ClassVar[str] = "7scenes_sfm_triangulated"
    all_images: ClassVar[str] = "triangulated"
    query_list: ClassVar[str] = "triangulated/list_test.txt"
    source: ClassVar[str] = (
        "The models come from hloc/pipelines/7Scenes/README.md of "
        "https://github.com/cvg/Hierarchical-Localization."
    )

    def thresholds(self, query_list: str) -> tuple[tuple[float, float], ...]:
        """Return the usual thresholds: 5 cm and 5 degrees, and finer ones."""
        return (0.01, 1.0), (0.02, 2.0), (0.05, 5.0)
