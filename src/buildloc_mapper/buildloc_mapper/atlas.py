"""Keyframes linked into submaps: a stretch that links to nothing starts a new one, a revisit joins them."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from buildloc_msgs_py.types import Frame
from numpy.typing import NDArray

from buildloc_mapper.appearance import Appearance
from buildloc_mapper.config import MapperConfig
from buildloc_mapper.pose_graph import Edge, PoseGraph, Turn
from buildloc_mapper.registration import Link, Packed, Prepared, Registration, Rejection, link_covariance
from buildloc_mapper.similarity import Similarity

ORIGIN = Similarity(0.0, 0.0, 0.0, 1.0)
STRONG = 4.0  # inliers over min_inliers of a link that needs no second witness
SIGMAS = 3.0
AGREE_M = 5.0  # two links between the same places tell the same: drift between the two is in it
AGREE_RAD = math.radians(5.0)
AGREE_LOG_SCALE = 0.1
DOUBTED = 50  # links that wait for a second witness


@dataclass(frozen=True)
class _Keyframe:
    stamp_ns: int
    prepared: Prepared | Packed

    def unpacked(self) -> Prepared:
        return self.prepared if isinstance(self.prepared, Prepared) else self.prepared.unpacked()

    def packed(self) -> _Keyframe:
        prepared = self.prepared
        return _Keyframe(self.stamp_ns, prepared.packed() if isinstance(prepared, Prepared) else prepared)

    @property
    def heading_rad(self) -> float:
        rest = self.prepared if isinstance(self.prepared, Prepared) else self.prepared.rest
        return rest.level.heading_rad


class Atlas:
    """Every keyframe of a flight, by ids 0, 1, 2, ... that stay, in one :class:`PoseGraph` per submap.

    ``counts`` says how often what happened: links that were rejected, by reason, gimbal turns that were left
    out, joins of submaps.
    """

    def __init__(self, config: MapperConfig) -> None:
        self._config = config
        self.registration = Registration(config)
        self.reset()

    def reset(self) -> None:
        """Forget the flight."""
        self.counts: Counter[str] = Counter()
        self._keyframes: list[_Keyframe] = []
        self._submaps: list[PoseGraph] = []  # of every keyframe
        self._appearance = Appearance()
        self._doubted: list[Edge] = []

    def submap(self, keyframe: int) -> PoseGraph:
        """The submap that a keyframe belongs to."""
        return self._submaps[keyframe]

    def stamp_ns(self, keyframe: int) -> int:
        """Capture time of a keyframe."""
        return self._keyframes[keyframe].stamp_ns

    def prepared(self, keyframe: int) -> Prepared:
        """A keyframe as registration takes it."""
        return self._keyframes[keyframe].unpacked()

    def submaps(self) -> list[PoseGraph]:
        """Every submap once, the oldest first."""
        return list({id(graph): graph for graph in self._submaps}.values())

    def add(self, frame: Frame) -> int:
        """Link a frame later than all before; its id. It stays a submap of its own until something links."""
        prepared = self.registration.prepare(frame)
        keyframe = len(self._keyframes)
        self._keyframes.append(_Keyframe(frame.stamp_ns, prepared))
        first = self._latest_link(keyframe, prepared)
        graph = PoseGraph(self._config) if first is None else self._submaps[first.earlier]
        self._submaps.append(graph)
        if first is None:
            graph.add(keyframe, frame.stamp_ns, ORIGIN, [])
        else:
            guess = graph.poses[first.earlier].compose(first.transform)
            edges = [first, *self._skip_links(first, guess, prepared)]
            graph.add(keyframe, frame.stamp_ns, guess, edges, self._turns(first))
        self._revisits(keyframe, prepared)
        self._appearance.add(prepared.signature)
        passed = keyframe - self._recent
        if passed >= 0:
            self._keyframes[passed] = self._keyframes[passed].packed()
        return keyframe

    @property
    def _recent(self) -> int:
        """Keyframes that a new one is linked to without a search."""
        return 1 + max(self._config.fallback_keyframes, self._config.skip_links)

    def _register(
        self, earlier: int, keyframe: int, prepared: Prepared, kind: str, turned_rad: float | None = None
    ) -> Edge | None:
        link = self.registration.register(self._keyframes[earlier].unpacked(), prepared, turned_rad)
        return self._edge(link, earlier, keyframe, kind)

    def _edge(self, link: Link | Rejection, earlier: int, keyframe: int, kind: str) -> Edge | None:
        if isinstance(link, Link):
            covariance = link_covariance(link, self._config)
            return Edge(earlier, keyframe, link.transform, link.inliers, covariance, loop=kind == "loop_")
        self.counts[f"rejected_{kind}{link.reason}"] += 1
        return None

    def _latest_link(self, keyframe: int, prepared: Prepared) -> Edge | None:
        """The link to the latest keyframe that there is one to, in whatever submap."""
        for earlier in range(keyframe - 1, max(-1, keyframe - 2 - self._config.fallback_keyframes), -1):
            if (edge := self._register(earlier, keyframe, prepared, "")) is not None:
                return edge
        return None

    def _skip_links(self, first: Edge, guess: Similarity, prepared: Prepared) -> Iterator[Edge]:
        """Links to keyframes before the one that the first link found, from where they must lie."""
        graph = self._submaps[first.earlier]
        for earlier in range(first.earlier - 1, max(-1, first.earlier - 1 - self._config.skip_links), -1):
            if self._submaps[earlier] is not graph:
                continue
            rough = graph.poses[earlier].inverse().compose(guess)
            link = self.registration.follow(self._keyframes[earlier].unpacked(), prepared.level, rough)
            if (edge := self._edge(link, earlier, first.later, "skip_")) is not None:
                yield edge

    def _turns(self, first: Edge) -> list[Turn]:
        """What the gimbal says about a link's turn, unless its heading stands still or is denied."""
        one, other = (self._keyframes[k].heading_rad for k in (first.earlier, first.later))
        denied = math.remainder(one - other - first.transform.yaw_rad, math.tau)
        contradicts = abs(denied) > SIGMAS * math.radians(self._config.sigma_heading_deg)
        if one == other or contradicts:
            self.counts["gimbal_yaw_frozen" if one == other else "gimbal_yaw_denied"] += 1
            return []
        return [Turn(first.earlier, first.later, one - other)]

    def _revisits(self, keyframe: int, prepared: Prepared) -> None:
        """Test a few earlier keyframes: near ones of the own submap, ones that look alike of the others."""
        for earlier in self._candidates(keyframe, prepared)[: self._config.loop_tests]:
            graph, other = self._submaps[keyframe], self._submaps[earlier]
            turned = None
            if graph is other:
                turned = graph.poses[keyframe].yaw_rad - graph.poses[earlier].yaw_rad
            edge = self._register(earlier, keyframe, prepared, "loop_", turned)
            if edge is not None and self._believe(edge):
                return

    def _candidates(self, keyframe: int, prepared: Prepared) -> list[int]:
        """The best of the other submaps, then the nearest and the most alike that may be near, in turns."""
        graph = self._submaps[keyframe]
        ids = np.arange(keyframe, dtype=np.int64)
        own = np.array([submap is graph for submap in self._submaps[:keyframe]], dtype=bool)
        lists: list[list[int]] = []
        if not own.all():
            lists.append(self._appearance.alike(prepared.signature, ids[~own]).tolist())
        ids = ids[own & (ids <= keyframe - self._config.loop_gap)]
        near = self._near(graph, keyframe, ids)
        if len(near):
            lists.append(near.tolist())
            lists.append(self._appearance.alike(prepared.signature, near).tolist())
        in_turns = [candidate for rank in zip(*lists, strict=False) for candidate in rank]
        longest = max(lists, key=len, default=[])
        return list(dict.fromkeys([*in_turns, *longest]))

    def _near(self, graph: PoseGraph, keyframe: int, ids: NDArray[np.int64]) -> NDArray[np.int64]:
        """Those of ``ids`` that may be within the loop radius, the nearest first: as far as the place of the
        keyframe is uncertain, they may be nearer than they seem."""
        if not len(ids):
            return ids
        here = graph.poses[keyframe]
        places = np.array([graph.poses[int(i)][:2] for i in ids])
        distances = np.linalg.norm(places - here[:2], axis=1)
        reach = self._config.loop_radius_m + SIGMAS * graph.place_sigma_m(keyframe)
        order = np.argsort(distances, kind="stable")
        near: NDArray[np.int64] = ids[order[distances[order] <= reach]]
        return near

    def _believe(self, edge: Edge) -> bool:
        """Take a link to an earlier place into the graph if it has many inliers, says what the graph expects
        or what an earlier one said; otherwise it waits for one that does."""
        submaps = self._submaps
        graph, other = submaps[edge.later], submaps[edge.earlier]
        ends = {id(graph), id(other)}
        same = [d for d in self._doubted if {id(submaps[d.earlier]), id(submaps[d.later])} == ends]
        witnesses = [doubted for doubted in same if self._agree(doubted, edge)]
        strong = edge.inliers >= STRONG * self._config.min_inliers
        if not (strong or witnesses or self._expected(edge)):
            self.counts["loops_doubted"] += 1
            self._doubted = [*self._doubted, edge][-DOUBTED:]
            return False
        self._doubted = [doubted for doubted in self._doubted if doubted not in same]
        if graph is other:
            graph.link([*witnesses, edge])
        else:
            self._join(graph, other, [*witnesses, edge])
        return True

    def _expected(self, edge: Edge) -> bool:
        """Whether a link within a submap says what the graph says, within its uncertainty."""
        graph = self._submaps[edge.later]
        if graph is not self._submaps[edge.earlier]:
            return False
        told, here = graph.poses[edge.earlier].compose(edge.transform), graph.poses[edge.later]
        sigma = math.hypot(graph.place_sigma_m(edge.later), self._config.sigma_position_m)
        return math.dist(told[:2], here[:2]) <= SIGMAS * sigma

    def _correction(self, edge: Edge) -> Similarity:
        """Where the frame of the later keyframe's submap lies in that of the earlier one's by a link."""
        later, earlier = self._submaps[edge.later].poses[edge.later], self._submaps[edge.earlier].poses
        return earlier[edge.earlier].compose(edge.transform).compose(later.inverse())

    def _agree(self, one: Edge, other: Edge) -> bool:
        """Whether two links put the newer keyframe in the same place."""
        here = self._submaps[other.later].poses[other.later]
        first, second = (self._oriented(e, other).compose(here) for e in (one, other))
        turned = math.remainder(first.yaw_rad - second.yaw_rad, math.tau)
        grown = math.log(first.scale / second.scale)
        return (
            math.dist(first[:2], second[:2]) < AGREE_M
            and abs(turned) < AGREE_RAD
            and abs(grown) < AGREE_LOG_SCALE
        )

    def _oriented(self, edge: Edge, like: Edge) -> Similarity:
        """The correction of a link, in the direction of another's between the same submaps."""
        correction = self._correction(edge)
        same_way = self._submaps[edge.later] is self._submaps[like.later]
        return correction if same_way else correction.inverse()

    def _join(self, graph: PoseGraph, other: PoseGraph, edges: list[Edge]) -> None:
        """One submap of two, in the frame of the older."""
        correction = self._correction(edges[-1])  # graph -> other
        if min(other.poses) < min(graph.poses):
            joined = other.joined(graph, correction, edges)
        else:
            joined = graph.joined(other, correction.inverse(), edges)
        self._submaps = [joined if g is graph or g is other else g for g in self._submaps]
        self.counts["joins"] += 1
