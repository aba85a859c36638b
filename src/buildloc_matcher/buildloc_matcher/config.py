"""Every parameter of the matcher, with its unit, default and range; and its presets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

from buildloc_msgs_py.config import ConfigError, check, from_mapping, param

VOTES = ("score", "evidence")
SELECTIONS = ("rigid", "grow")


@dataclass(frozen=True)
class MatcherConfig:
    """Parameters of descriptor matching, voting, selection, refinement and acceptance.

    The defaults are the preset ``default``; :data:`PRESETS` has the paper's.
    """

    min_area_m2: float = param(20.0, "smallest footprint used, reference and query alike, m2", 0.0, 1e5)
    tau_angle_deg: float = param(25.0, "filter: L1 distance of the sorted angles (Eq. 1), deg", 0.1, 180.0)
    tau_perimeter: float = param(0.2, "filter: relative perimeter difference (Eq. 1)", 0.01, 0.95)
    tau_shape: float = param(0.3, "filter: mean shape difference (Eq. 1)", 0.01, 1.0)
    score_angle_deg: float = param(
        40.0, "score: angle distance that counts as none in common, deg", 0.1, 180.0
    )
    score_perimeter: float = param(
        0.3, "score: relative perimeter difference that counts as none in common; 1 in Eq. 2", 0.01, 5.0
    )
    score_area: float = param(
        0.45, "score: relative area difference that counts as none in common", 0.01, 5.0
    )
    area_weight: float = param(
        3.0, "weight of the areas in the score; angles weigh 2, Eq. 2 has 0", 0.0, 10.0
    )
    centre_weight: float = param(3.0, "weight of the central triangle; its neighbours weigh 1", 0.1, 10.0)
    matches_per_star: int = param(100, "best reference matches kept per query star", 1, 10000)
    max_stars: int = param(
        64, "stars of a map that a first look matches, a fixed sample; 0: 4096", 0, 1000000
    )
    second_look: int = param(
        8, "thinned triangulations added when the first look convinces nobody; 0: no second look", 0, 32
    )
    second_look_matches: int = param(500, "matches_per_star of the second look", 1, 10000)
    second_look_places: int = param(
        200_000, "places where the second look tries pairs of buildings, at most; 0: none", 0, 100_000_000
    )
    reseeded: int = param(100, "hypotheses around which seeds are laid anew, at most; 0: none", 0, 10_000)
    scale_gate: float = param(0.15, "largest deviation of the map-to-world scale from 1", 0.0, 0.9)
    sigma_m: float = param(2.0, "error of a map building against its neighbours, per axis, m", 0.1, 50.0)
    match_share: float = param(0.7, "share of the map's real buildings that the reference has", 0.05, 0.99)
    false_per_km2: float = param(
        130.0, "buildings that the segmenter invents on a square kilometre, per km2", 0.0, 1e5
    )
    false_area_m2: float = param(33.0, "median area of such a building, m2", 1.0, 1e4)
    seen_share: float = param(
        0.5, "share of the reference's observable buildings that the map has at least", 0.05, 0.95
    )
    sigma_log_area: float = param(0.25, "error of the logarithm of a map building's area", 0.01, 5.0)
    area_share: float = param(0.8, "share of the matched buildings whose area is right up to that", 0.0, 0.99)
    sigma_scale: float = param(0.05, "error of the map's scale, from that of the altitude", 0.001, 1.0)
    votes: str = param(
        "evidence", "what a hypothesis votes with: score (Eq. 3) or evidence of its surroundings"
    )
    bin_size_m: float = param(100.0, "side of a voting bin, m", 1.0, 10000.0)
    rotation_tolerance_deg: float = param(
        10.0, "half width of a rotation-consistent cluster, deg", 0.1, 180.0
    )
    min_votes: int = param(1, "fewest rotation-consistent votes of a candidate", 1, 10000)
    top_k: int = param(100, "candidates rescored", 1, 10000)
    selection: str = param(
        "grow",
        "candidates are scored as rigid (Eq. 4) or grow from their best seed and follow the map's bend",
    )
    mnn_distance_m: float = param(10.0, "largest distance of a mutual nearest-neighbour pair, m", 0.1, 1000.0)
    observable_margin_m: float = param(
        15.0, "margin around the hull of the map that was observed, m", 0.0, 1000.0
    )
    observable_radius_m: float = param(
        60.0, "ground around each map building that was observed, m", 1.0, 10000.0
    )
    refine_frames: int = param(20, "most recent keyframes used by the refinement", 1, 10000)
    refine_distance_m: float = param(15.0, "1-NN distance of the first refinement step, m", 0.1, 1000.0)
    refine_last_distance_m: float = param(8.0, "1-NN distance of the last refinement step, m", 0.1, 1000.0)
    refine_iterations: int = param(6, "refinement steps while the distance shrinks", 1, 100)
    sigma_frame_m: float = param(
        0.4, "least error of a building's centroid that is new in every frame, per axis, m", 0.05, 10.0
    )
    sigma_building_m: float = param(
        0.6, "least error of it that all frames share, the reference's own included, per axis, m", 0.05, 10.0
    )
    walk_m: float = param(
        0.03,
        "least error of the mapper from keyframe to keyframe, per axis, m per root of a metre",
        0.001,
        5.0,
    )
    walk_deg: float = param(0.03, "the same of its heading, deg per root of a metre", 0.001, 10.0)
    sigma_registration_m: float = param(
        1.5, "error that all buildings of the reference share, per axis, m", 0.0, 10.0
    )
    min_optimum_lead: float = param(
        5.0, "smallest lead of the refined pose over another one near by that fits too, nats", 0.0, 1e4
    )
    min_buildings: int = param(12, "fewest buildings in the map for a fix", 3, 100000)
    min_jaccard: float = param(0.2, "smallest MNN-Jaccard of an accepted candidate", 0.0, 1.0)
    target_false_fix_rate: float = param(
        1e-4, "how often a map that lies nowhere near may be accepted, at most", 1e-12, 0.5
    )
    rival_distance_m: float = param(15.0, "candidates further away than this are elsewhere, m", 0.0, 1e6)
    min_pairs: int = param(10, "fewest buildings of the map matched for a fix", 3, 100000)
    refine_min_buildings: int = param(
        3, "fewest distinct reference buildings that the refinement matches for a fix", 3, 1000
    )
    max_residual_m: float = param(10.0, "largest RMS distance of the matched pairs for a fix, m", 0.1, 1000.0)
    sigma_up_m: float = param(100.0, "standard deviation reported for the altitude, m", 0.1, 10000.0)
    follow_frames: int = param(4, "fewest latest keyframes that are asked whether they agree", 1, 100)
    follow_nats: float = param(
        7.0, "evidence that decides for or against a predicted place, nats; less decides nothing", 0.1, 1e3
    )
    min_recent_nats: float = param(
        0.5,
        "smallest evidence of a first fix, and lead over places near by, of the recent and of the latest "
        "frames, nats per building",
        0.0,
        1e3,
    )
    max_jump_sigmas: float = param(
        5.0, "farthest that an agreement may lie from the prediction, standard deviations", 1.0, 100.0
    )
    drift_share: float = param(
        0.02, "standard deviation of a place carried on without an agreement, over the distance", 0.0, 1.0
    )
    drift_deg_per_km: float = param(3.0, "the same of the heading, deg per km", 0.0, 1000.0)
    max_coast_m: float = param(
        800.0, "distance without an agreement after which a place is withdrawn, m", 1.0, 1e5
    )
    max_track_sigma_m: float = param(
        19.0,
        "standard deviation without an agreement at which a place is withdrawn, m; 19 m are a "
        "protection level of 100 m",
        0.1,
        1000.0,
    )
    check_keyframes: int = param(
        6, "keyframes from one global search to the next while tracking, which must confirm", 1, 10000
    )


DEFAULT = "default"
# The paper's stages and parameters; what it leaves open is said in docs/matching.md.
PRESETS: Mapping[str, Mapping[str, Any]] = {
    DEFAULT: {},
    "paper": {
        "tau_angle_deg": 15.0, "tau_perimeter": 0.3, "tau_shape": 0.3,
        "score_angle_deg": 15.0, "score_perimeter": 1.0, "area_weight": 0.0, "centre_weight": 1.0,
        "matches_per_star": 50, "max_stars": 0, "second_look": 0, "votes": "score", "min_votes": 3,
        "top_k": 20, "selection": "rigid", "mnn_distance_m": 10.0, "refine_distance_m": 50.0,
        "refine_last_distance_m": 15.0, "rival_distance_m": 200.0,
    },
}  # fmt: skip


def preset_values(name: str) -> dict[str, Any]:
    """All parameters of a preset. Raises ConfigError for an unknown name."""
    if name not in PRESETS:
        raise ConfigError(f"preset {name} is unknown; there are {', '.join(PRESETS)}")
    return {field.name: field.default for field in fields(MatcherConfig)} | dict(PRESETS[name])


def matcher_config(values: Mapping[str, Any] | None = None) -> MatcherConfig:
    """The config of named values over those of ``preset`` among them. Raises ConfigError."""
    given = dict(values or {})
    base = preset_values(str(given.pop("preset", DEFAULT)))
    return check_matcher(from_mapping(MatcherConfig, base | given))


def check_matcher(config: MatcherConfig) -> MatcherConfig:
    """The config itself. Raises ConfigError for the first value out of range or not among its choices."""
    check(config)
    for name, value, choices in (("votes", config.votes, VOTES), ("selection", config.selection, SELECTIONS)):
        if value not in choices:
            raise ConfigError(f"parameter {name} = {value} is not one of {', '.join(choices)}")
    return config
