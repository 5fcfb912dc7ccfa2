"""Localize the frames of a video one after the other."""

from typing import Protocol

import pycolmap

from .given import Image

REMEMBERED = 10  # frames, after which a camera whose pose is not known may be anywhere


class Localizes(Protocol):
    """What a `Localizer` does for its tracker."""

    def localize(
        self,
        image: Image,
        camera: pycolmap.Camera | None = None,
        mask: Image | None = None,
        near: pycolmap.Rigid3d | None = None,
        radius: float | None = None,
    ) -> tuple[pycolmap.Rigid3d | None, dict]:
        """Localize a photo."""

    def is_far(self, cam_from_world: pycolmap.Rigid3d) -> bool:
        """Tell whether a pose is too far from the map for `near`."""


class Tracker:
    """Localizes the frames of a video, each near where the last ones were.

    A pose depends on its frame alone: the last ones only tell with which map images it is matched
    first. So nothing is smoothed, and a frame after a jump is localized like any photo.

    Args:
        localizer: the map.
        camera: intrinsics of all frames; default: see `Localizer.localize`.
        radius: see `Localizer.localize`.

    Example:
        >>> tracker = Localizer("place.hlm").track(camera)  # doctest: +SKIP
        >>> for frame in frames:  # doctest: +SKIP
        ...     cam_from_world, info = tracker.localize(frame)
    """

    def __init__(
        self,
        localizer: Localizes,
        camera: pycolmap.Camera | None = None,
        radius: float | None = None,
    ):
        self.localizer, self.camera, self.radius = localizer, camera, radius
        self._last: list[pycolmap.Rigid3d | None] = []  # of the last frames

    def localize(
        self, image: Image, mask: Image | None = None
    ) -> tuple[pycolmap.Rigid3d | None, dict]:
        """Localize the next frame, see `Localizer.localize`.

        Args:
            image: its file, or its pixels.
            mask: see `Localizer.localize`.
        """
        near = self._expected()
        radius = self.radius if near else None
        found = self.localizer.localize(image, self.camera, mask, near, radius)
        self._last = [*self._last, found[0]][-REMEMBERED:]
        return found

    def _expected(self) -> pycolmap.Rigid3d | None:
        """Return the pose that the next frame has if the camera moves on as before."""
        known = [pose for pose in self._last if pose is not None]
        if not known:
            return None
        expected = known[-1]
        if None not in self._last[-2:] and len(known) > 1:
            expected = expected * known[-2].inverse() * expected
        candidates = (expected, known[-1])
        return next((one for one in candidates if not self.localizer.is_far(one)), None)
