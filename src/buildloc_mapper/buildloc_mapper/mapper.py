"""Keyframes in, map out: register, optimise, fuse, extract."""

from __future__ import annotations

import math
import time
from collections import Counter
from dataclasses import dataclass

from buildloc_msgs_py.config import check
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.ground import validate_frame
from buildloc_msgs_py.types import Frame, Keyframe, LocalMap, Mask

from buildloc_mapper.config import MapperConfig
from buildloc_mapper.extraction import Extractor, LocalOutlines
from buildloc_mapper.fusion import Fusion, View
from buildloc_mapper.pose_graph import Edge, optimize
from buildloc_mapper.registration import Link, Prepared, Registration
from buildloc_mapper.similarity import Similarity

ORIGIN = Similarity(0.0, 0.0, 0.0, 1.0)


class MapperError(BuildlocError):
    """A keyframe cannot be added."""


@dataclass(frozen=True)
class MapUpdate:
    """The optimised keyframes, the buildings of the map with their outlines, and the funnel.

    ``links``: earlier and later keyframe, by their place in ``keyframes``, and what links them:
    ``consecutive``, ``skip``, ``loop`` or ``join``.
    """

    keyframes: tuple[Keyframe, ...]
    local_map: LocalMap
    outlines: LocalOutlines
    funnel: dict[str, float]
    links: tuple[tuple[int, int, str], ...]


@dataclass(frozen=True)
class _Node:
    stamp_ns: int
    prepared: Prepared
    view: View


class Mapper:
    """One growing map. ``buildloc_map`` has its origin and heading from the map's first keyframe."""

    def __init__(self, config: MapperConfig) -> None:
        check(config)
        self.config = config
        self._registration = Registration(config)
        self.reset()

    def reset(self) -> None:
        """Forget the flight."""
        self._rejected: Counter[str] = Counter()
        self._restarts = 0
        self._earlier = 0
        self._nodes: list[_Node] = []
        self._fusion, self._extractor = Fusion(self.config), Extractor(self.config)
        self._start_anew()

    def _start_anew(self) -> None:
        self._earlier += len(self._nodes)
        self._nodes = []
        self._poses: list[Similarity] = []
        self._edges: list[Edge] = []
        self._lost = 0

    def add(self, frame: Frame, mask: Mask) -> MapUpdate | None:
        """Add a keyframe and its mask; the new map, or None when the keyframe links to nothing.

        After ``max_lost`` such keyframes in a row the map starts anew from the latest. Raises
        MapperError when frame and mask do not belong together, WireError for unusable telemetry.
        """
        validate_frame(frame)
        if mask.stamp_ns != frame.stamp_ns or mask.pixels.shape != frame.image_bgr.shape[:2]:
            raise MapperError("mask and image differ in stamp or size; feed the segmenter's own masks")
        started = time.perf_counter()
        view = View.of(frame, mask, self.config)
        node = _Node(frame.stamp_ns, self._registration.prepare(frame), view)
        if not self._attach(node):
            return None
        self._close_loops()
        self._poses = optimize(self._poses, self._edges, self.config)
        return self._update(started)

    def finish(self) -> MapUpdate | None:
        """The map with every keyframe drawn where it is by now; None before the first."""
        return self._update(time.perf_counter(), everything=True) if self._nodes else None

    def _update(self, started: float, everything: bool = False) -> MapUpdate:
        ids = range(self._earlier, self._earlier + len(self._nodes))
        views = {i: node.view for i, node in zip(ids, self._nodes, strict=True)}
        dirty = self._fusion.update(views, dict(zip(ids, self._poses, strict=True)), everything)
        found = self._extractor.update(self._fusion, dirty, self._nodes[-1].stamp_ns)
        keyframes = tuple(
            Keyframe(n.stamp_ns, p.x_m, p.y_m, p.yaw_rad, p.scale)
            for n, p in zip(self._nodes, self._poses, strict=True)
        )
        funnel: dict[str, float] = {
            "keyframes": len(self._nodes),
            "loop_closures": sum(e.loop for e in self._edges),
            "restarts": self._restarts,
            "buildings": len(found.local_map),
            "cut": int(found.local_map.cut.sum()),
            "redraws_waiting": self._fusion.waiting,
            **{f"rejected_{reason}": count for reason, count in sorted(self._rejected.items())},
            "seconds": time.perf_counter() - started,
        }
        links = tuple((e.earlier, e.later, "loop" if e.loop else "consecutive") for e in self._edges)
        return MapUpdate(keyframes, found.local_map, found.outlines, funnel, links)

    def _link(self, earlier: int, node: _Node, loop: bool = False) -> bool:
        link = self._registration.register(self._nodes[earlier].prepared, node.prepared)
        if not isinstance(link, Link):
            self._rejected[("loop_" if loop else "") + link.reason] += 1
            return False
        later = len(self._nodes) - 1 if loop else len(self._nodes)
        self._edges.append(Edge(earlier, later, link.transform, link.inliers, loop))
        return True

    def _attach(self, node: _Node) -> bool:
        """Link a keyframe to the latest one it registers with; the first one starts the map."""
        latest = len(self._nodes) - 1
        for earlier in range(latest, max(-1, latest - 1 - self.config.fallback_keyframes), -1):
            if self._link(earlier, node):
                self._poses.append(self._poses[earlier].compose(self._edges[-1].transform))
                self._nodes.append(node)
                self._lost = 0
                return True
        self._lost += 1
        if self._nodes and self._lost < self.config.max_lost:
            return False
        self._restarts += bool(self._nodes)
        self._start_anew()
        self._nodes, self._poses = [node], [ORIGIN]
        return True

    def _close_loops(self) -> None:
        """Test the spatially nearest keyframes of long ago against the newest one."""
        newest = len(self._nodes) - 1
        here = self._poses[newest]
        distances = sorted(
            (math.hypot(p.x_m - here.x_m, p.y_m - here.y_m), i)
            for i, p in enumerate(self._poses[: max(0, newest - self.config.loop_gap + 1)])
        )
        near = [i for distance, i in distances if distance <= self.config.loop_radius_m]
        for earlier in near[: self.config.loop_tests]:
            self._link(earlier, self._nodes[newest], loop=True)
