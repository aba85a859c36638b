"""The whole method, offline, in one place: a frame in, an answer out. The node graph does the same live."""

from __future__ import annotations

from buildloc_mapper.config import MapperConfig
from buildloc_mapper.mapper import Mapper
from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.matcher import Answer, Matcher
from buildloc_matcher.reference.database import ReferenceDatabase
from buildloc_matcher.session import frames_kept
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.ground import observe
from buildloc_msgs_py.types import Frame, FrameObservation, NoFix
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
        self._matcher = Matcher(database, matcher_config)
        self._config = matcher_config
        self._observations: list[FrameObservation] = []

    def process(self, frame: Frame) -> Answer | None:
        """The answer at this frame; None when it is not a keyframe.

        A keyframe that cannot be mapped, whose gimbal looks at the horizon say, gives no fix and the reason.
        Raises BuildlocError when the frame is not one, or the network fails.
        """
        mask = self._segmenter.process(frame)
        if mask is None:
            return None
        try:
            seen = observe(
                mask.pixels, frame.stamp_ns, frame.camera, frame.altitude_m, frame.attitude_xyzw,
                self._config.min_area_m2,
            )  # fmt: skip
            self._observations = [*self._observations, seen][-frames_kept(self._config) :]
            update = self._mapper.add(frame, mask)
        except BuildlocError as error:
            return Answer(NoFix(frame.stamp_ns, str(error)), (), {})
        if update is None:
            return Answer(NoFix(frame.stamp_ns, "keyframe links to none of the latest keyframes"), (), {})
        return self._matcher.fix(update.local_map, update.keyframes, self._observations)
