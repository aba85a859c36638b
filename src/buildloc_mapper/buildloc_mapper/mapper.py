"""Keyframes in, map out: register, optimise, fuse, extract."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import cv2
from buildloc_msgs_py.config import check
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.ground import validate_frame
from buildloc_msgs_py.types import Frame, Keyframe, LocalMap, Mask, Tracked

from buildloc_mapper.atlas import Atlas
from buildloc_mapper.config import MapperConfig
from buildloc_mapper.extraction import Extractor, LocalOutlines
from buildloc_mapper.fusion import Fusion, View
from buildloc_mapper.pose_graph import PoseGraph
from buildloc_mapper.tracking import Lost, Tracker


class MapperError(BuildlocError):
    """A keyframe cannot be added."""


@contextmanager
def _opencv_may_refuse() -> Iterator[None]:
    """What OpenCV cannot work on is a frame that cannot be used, not the end of the flight."""
    try:
        yield
    except cv2.error as error:
        raise MapperError(f"OpenCV refuses the frame: {error.err}; check image and calibration") from error


@dataclass(frozen=True)
class MapUpdate:
    """The optimised keyframes of one submap, its buildings with their outlines, and the funnel.

    ``scale_sigma`` in the funnel is the relative standard deviation of the map's scale. ``links``: the
    earlier and the later keyframe, by their place in ``keyframes``, and what links them: ``consecutive``,
    ``skip`` or ``loop``.
    """

    keyframes: tuple[Keyframe, ...]
    local_map: LocalMap
    outlines: LocalOutlines
    funnel: dict[str, float]
    links: tuple[tuple[int, int, str], ...]


class Mapper:
    """One growing map. ``buildloc_map`` has its origin and heading from the map's first keyframe, its scale
    from the altimeter."""

    def __init__(self, config: MapperConfig) -> None:
        check(config)
        self.config = config
        self._atlas = Atlas(config)
        self._tracker = Tracker(config, self._atlas.registration)
        self.reset()

    def reset(self) -> None:
        """Forget the flight."""
        self._atlas.reset()
        self._tracker.reset()
        self._views: dict[int, View] = {}
        self._fusion, self._extractor = Fusion(self.config), Extractor(self.config)
        self._latest: int | None = None  # keyframe of a map
        self._latest_stamp_ns: int | None = None

    @_opencv_may_refuse()
    def add(self, frame: Frame, mask: Mask) -> MapUpdate | None:
        """Add a keyframe and its mask; the new map, or None when the keyframe links to nothing yet.

        Such a keyframe is kept: when a later one links to it, the two are a new map, which is joined to the
        earlier ones as soon as the same ground is seen again. Raises MapperError when frame and mask do not
        belong together, the frame is not later than the one before or OpenCV refuses it, WireError for
        unusable telemetry; the map is then as it was.
        """
        validate_frame(frame)
        if mask.stamp_ns != frame.stamp_ns or mask.pixels.shape != frame.image_bgr.shape[:2]:
            raise MapperError("mask and image differ in stamp or size; feed the segmenter's own masks")
        if self._latest_stamp_ns is not None and frame.stamp_ns <= self._latest_stamp_ns:
            self._atlas.counts["rejected_stamp"] += 1
            late_s = (self._latest_stamp_ns - frame.stamp_ns) * 1e-9
            raise MapperError(
                f"keyframe is {late_s:.3f} s before the latest or at its stamp; feed keyframes in the order "
                "they were taken, and reset before another flight"
            )
        started = time.perf_counter()
        view = View.of(frame, mask, self.config)
        self._latest_stamp_ns = frame.stamp_ns
        keyframe = self._atlas.add(frame)
        self._views[keyframe] = view
        if keyframe > 0 and len(self._atlas.submap(keyframe).poses) == 1:
            return None
        graph, before, self._latest = self._atlas.submap(keyframe), self._latest, keyframe
        T_new_old = None  # noqa: N806
        if before is not None and before in graph.poses:
            T_new_old = graph.poses[keyframe].inverse().compose(graph.poses[before])  # noqa: N806
        update = self._update(keyframe, started)
        # Only now: whoever is told of a frame tracked in this keyframe is to know the keyframe.
        self._tracker.rebase(frame, self._atlas.prepared(keyframe), T_new_old)
        return update

    @_opencv_may_refuse()
    def track(self, frame: Frame) -> Tracked | Lost:
        """Where a frame between keyframes is, in the latest keyframe of the map; may run while a keyframe is
        added on another thread. Raises WireError for unusable telemetry, MapperError where OpenCV refuses the
        frame."""
        return self._tracker.track(frame)

    def finish(self) -> MapUpdate | None:
        """The map with every keyframe drawn where it is by now; None before the first."""
        if self._latest is None:
            return None
        return self._update(self._latest, time.perf_counter(), everything=True)

    def _update(self, keyframe: int, started: float, everything: bool = False) -> MapUpdate:
        graph, stamp = self._atlas.submap(keyframe), self._atlas.stamp_ns
        dirty = self._fusion.update(self._views, graph.poses, everything)
        found = self._extractor.update(self._fusion, dirty, stamp(keyframe))
        keyframes = tuple(
            Keyframe(stamp(i), p.x_m, p.y_m, p.yaw_rad, p.scale) for i, p in graph.poses.items()
        )
        sizes = [len(submap.poses) for submap in self._atlas.submaps()]
        funnel: dict[str, float] = {
            "keyframes": len(keyframes),
            "submaps": sum(size > 1 for size in sizes),
            "unlinked": sum(size == 1 for size in sizes),
            "loop_closures": sum(edge.loop for edge in graph.edges),
            "scale_sigma": graph.scale_sigma(keyframe),
            "buildings": len(found.local_map),
            "cut": int(found.local_map.cut.sum()),
            "redraws_waiting": self._fusion.waiting,
            **dict(sorted(self._atlas.counts.items())),
            "seconds": time.perf_counter() - started,
        }
        return MapUpdate(keyframes, found.local_map, found.outlines, funnel, tuple(_links(graph)))


def _links(graph: PoseGraph) -> Iterator[tuple[int, int, str]]:
    """The edges of a graph as MapUpdate tells them: a keyframe's first one is that to its predecessor."""
    place = {keyframe: i for i, keyframe in enumerate(graph.poses)}
    linked: set[int] = set()
    for edge in graph.edges:
        kind = "loop" if edge.loop else "skip" if edge.later in linked else "consecutive"
        yield place[edge.earlier], place[edge.later], kind
        linked.add(edge.later)
