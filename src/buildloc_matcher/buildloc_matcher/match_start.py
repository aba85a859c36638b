"""From the best candidate of a map to where its keyframes are: where the refinement begins.

A match grows from house to house and may end before the flight does; how far it is from a keyframe to the
buildings that were matched tells how well its place is known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from buildloc_msgs_py.types import Keyframe

from buildloc_matcher.config import MatcherConfig
from buildloc_matcher.evidence import Ground, QueryMap
from buildloc_matcher.selection import Score, beyond_m, local_transform
from buildloc_matcher.window import Start, State, newest, start

START_M, START_DEG = 5.0, 1.5  # error of a grown match where its buildings are
MATCHED_M = 150.0  # with some matched buildings so near, a keyframe's place is told by the match
TRIES = 4  # pieces of the flight, from the newest back, that may agree with the reference


def start_of(
    score: Score, query: QueryMap, keyframes: Sequence[Keyframe], reference: Ground, config: MatcherConfig
) -> Start:
    """The last ``refine_frames`` keyframes, at least one, each where the match has it: the map may bend.

    Beyond the matched buildings a place errs by the heading they leave, and by that which walks at random
    after them, with the power 3/2 of the distance.
    """
    if config.selection == "rigid":
        return start(score.transform, keyframes, config)
    last = newest(keyframes, config.refine_frames)
    places_m = np.array([[k.x_m, k.y_m] for k in last])
    there = [local_transform(score, place_m, query, reference, config) for place_m in places_m]
    poses = [
        (*near.apply(place_m[None])[0], keyframe.yaw_rad + near.yaw_rad)
        for near, place_m, keyframe in zip(there, places_m, last, strict=True)
    ]
    away_m = beyond_m(score, places_m[-1], query)
    walk, turn = math.radians(config.walk_deg), math.radians(START_DEG)
    sigma_m = math.sqrt(START_M**2 + (turn * away_m) ** 2 + walk**2 * away_m**3 / 3.0)
    state = State(np.array(poses), np.array([0.0, math.log(there[-1].scale)]))
    return Start(last, state, sigma_m, math.sqrt(turn**2 + walk**2 * away_m))


def ends(score: Score, query: QueryMap, path: Sequence[Keyframe], config: MatcherConfig) -> list[int]:
    """Lengths of pieces of a path at whose end the reference may agree, the newest first: the whole, and
    such as end among matched buildings."""
    if config.selection == "rigid":
        return [len(path)]
    away_m = np.array([beyond_m(score, np.array([k.x_m, k.y_m]), query) for k in path])
    near = np.flatnonzero(away_m <= max(MATCHED_M, away_m.min())) + 1
    found = [len(path)]
    least = max(1, config.refine_frames // 2)  # keyframes of a piece, and from one to the next
    near = near[near >= least]
    while len(found) < TRIES and (before := near[near <= found[-1] - least]).size:
        found.append(int(before[-1]))
    return found
