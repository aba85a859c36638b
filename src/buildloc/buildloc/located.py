"""The answer of `buildloc locate`: a map placed in a reference, as JSON and as text."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from buildloc_matcher.matcher import Matcher
from buildloc_matcher.refinement import horizontal_variance
from buildloc_msgs_py.types import LocalMap

Answer = dict[str, Any]


def locate(matcher: Matcher, local_map: LocalMap, at_m: tuple[float, float] | None, top: int) -> Answer:
    """Fix of a point of the map (the mean of its buildings by default), or the reason why there is none.

    ``fix``: latitude and longitude of the point, yaw from the map's x axis to east, scale, covariance
    (2, 2) east, north in m2, score: log-odds in nats. ``candidates``: the same of the map's mean, ranked.
    """
    found = matcher.locate(local_map)
    refused = matcher.judge(found).reason
    ranked = []
    for rank, candidate in enumerate(found.candidates[:top], start=1):
        latitude, longitude = matcher.database.to_wgs84(candidate.x_m, candidate.y_m)
        ranked.append(
            {
                "rank": rank, "lat": latitude, "lon": longitude, "yaw_deg": math.degrees(candidate.yaw_rad),
                "scale": candidate.scale, "votes": candidate.votes, "mnn_jaccard": candidate.mnn_jaccard,
                "score": candidate.acceptance,
            }
        )  # fmt: skip
    fix = None
    if refused is None:
        at = local_map.centroids_m.mean(axis=0) if at_m is None else np.array(at_m)
        placed = matcher.place(found, at)
        east, north = placed.apply(at[None])[0]
        latitude, longitude = matcher.database.to_wgs84(float(east), float(north))
        score = found.scores[0]
        matched = matcher.database.centroids_m[score.pairs[:, 1]]
        variance = horizontal_variance(np.array([east, north]), matched, score.rms_m, matcher.config)
        fix = {
            "lat": latitude, "lon": longitude, "yaw_deg": math.degrees(placed.yaw_rad), "scale": placed.scale,
            "covariance": [[variance, 0.0], [0.0, variance]], "score": found.candidates[0].acceptance,
        }  # fmt: skip
    funnel = {name: value if math.isfinite(value) else None for name, value in found.funnel.items()}
    return {
        "fix": fix, "reason": refused, "candidates": ranked, "funnel": funnel, "seconds": found.seconds
    }  # fmt: skip


def table(answer: Answer) -> str:
    """For people: the candidates, then the fix or why there is none."""
    lines = ["rank  latitude    longitude    yaw_deg  scale  votes  jaccard   score"]
    lines += [
        f"{row['rank']:4d}  {row['lat']:10.6f}  {row['lon']:11.6f}  {row['yaw_deg']:7.1f}  "
        f"{row['scale']:5.3f}  {row['votes']:5.1f}  {row['mnn_jaccard']:7.3f}  {row['score']:6.1f}"
        for row in answer["candidates"]
    ]
    fix = answer["fix"]
    if fix is None:
        lines.append(f"no fix: {answer['reason']}")
    else:
        sigma = math.sqrt(fix["covariance"][0][0])
        lines.append(f"fix: {fix['lat']:.6f}, {fix['lon']:.6f}, sigma {sigma:.1f} m")
    lines.append(f"{sum(answer['seconds'].values()) * 1e3:.0f} ms")
    return "\n".join(lines)
