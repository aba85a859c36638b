"""The whole method, offline, in one place: a frame in, an answer out. The node graph does the same live."""

from __future__ import annotations

from buildloc_mapper.config import MapperConfig
from buildloc_mapper.mapper import Mapper
from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.matcher import Matcher
from buildloc_matcher.reference.database import ReferenceDatabase
from buildloc_matcher.seeker import Seeker
from buildloc_matcher.window import frames_kept
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.ground import observe
from buildloc_msgs_py.types import Fix, Frame, FrameObservation, Mask, NoFix, Tracked
from buildloc_segmenter.config import SegmenterConfig
from buildloc_segmenter.segmenter import Segmenter


class Localizer:
    """Localizes one flight in one reference database."""

    def __init__(
        self,
        database: ReferenceDatabase,
        segmenter_config: SegmenterConfig,
        mapper_config: MapperConfig,
        matcher_config: MatcherConfig,
    ) -> None:
        self._segmenter = Segmenter(segmenter_config)
        self._mapper = Mapper(mapper_config)
        self._seeker = Seeker(Matcher(database, matcher_config))
        self._config = matcher_config
        self._observations: list[FrameObservation] = []

    def process(self, frame: Frame) -> Fix | NoFix:
        """Where the camera was at this frame, or why that is not known.

        Raises BuildlocError when the frame is not one, or the network fails.
        """
        mask = self._segmenter.process(frame)
        try:
            return self._track(frame) if mask is None else self._map(frame, mask)
        except BuildlocError as error:  # the gimbal looks at the horizon, say: this frame alone has no fix
            return NoFix(frame.stamp_ns, str(error))

    def _track(self, frame: Frame) -> Fix | NoFix:
        """Between keyframes: from the latest keyframe on."""
        tracked = self._mapper.track(frame)
        if isinstance(tracked, Tracked):
            return self._seeker.locate(tracked)
        return NoFix(frame.stamp_ns, f"frame is not tracked: {tracked.reason}")

    def _map(self, frame: Frame, mask: Mask) -> Fix | NoFix:
        """At a keyframe: the map grows, and is searched for or held against the reference."""
        seen = observe(
            mask.pixels, frame.stamp_ns, frame.camera, frame.altitude_m, frame.attitude_xyzw,
            self._config.min_area_m2,
        )  # fmt: skip
        self._observations = [*self._observations, seen][-frames_kept(self._config) :]
        update = self._mapper.add(frame, mask)
        if update is None:
            return NoFix(frame.stamp_ns, "keyframe links to none of the latest keyframes")
        self._seeker.carry(update.keyframes)
        return self._seeker.solve(update.local_map, update.keyframes, self._observations).result
