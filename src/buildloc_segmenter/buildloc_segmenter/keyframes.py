"""Keyframe policy (paper, perception): enough rotation or enough time since the last keyframe."""

from __future__ import annotations

import math
from dataclasses import dataclass

from buildloc_segmenter.config import SegmenterConfig


@dataclass(frozen=True)
class Moment:
    """Capture time and in-plane rotation of an image."""

    stamp_ns: int
    heading_rad: float


def is_keyframe(last: Moment | None, now: Moment, config: SegmenterConfig) -> bool:
    """Whether ``now`` is a keyframe after ``last``; the first image is, and so is one from before."""
    if last is None or now.stamp_ns < last.stamp_ns:
        return True
    turned = abs(math.remainder(now.heading_rad - last.heading_rad, math.tau))
    elapsed_s = (now.stamp_ns - last.stamp_ns) * 1e-9
    return turned > math.radians(config.keyframe_rotation_deg) or elapsed_s >= config.keyframe_period_s
