"""Localize the frames of a video one after the other."""

from collections.abc import Callable

import pycolmap

from .given import Image

REMEMBERED = 10  # frames, after which a camera whose pose is not known may be anywhere


class Tracker:
    """Localizes the frames of a video, each near where the last ones were.

    A pose depends on its frame alone: the last ones only tell with which map images it is matched
    first. So nothing is smoothed, and a frame after a jump is localized like any photo.

    Args:
        localize: that of a `Localizer`.
        is_far: that of the same `Localizer`.
        camera: intrinsics of all frames; default: see `Localizer.localize`.
        radius: see `Localizer.localize`.

    Example:
        >>> tracker = Localizer("place.hlm").track(camera)  # doctest: +SKIP
        >>> for frame in frames:  # doctest: +SKIP
        ...     cam_from_world, info = tracker.localize(frame)
    """

    def __init__(
        self,
        localize: Callable[..., tuple[pycolmap.Rigid3d | None, dict]],
        is_far: Callable[[pycolmap.Rigid3d], bool],
        camera: pycolmap.Camera | None = None,
        radius: float | None = None,
    ):
        self._localize, self._is_far = localize, is_far
        self.camera, self.radius = camera, radius
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
        found = self._localize(image, self.camera, mask, near, radius)
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
        return next((one for one in candidates if not self._is_far(one)), None)
