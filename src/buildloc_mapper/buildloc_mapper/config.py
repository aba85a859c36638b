"""Every parameter of the mapper, with its unit, default and range."""

from __future__ import annotations

from dataclasses import dataclass

from buildloc_msgs_py.config import param


@dataclass(frozen=True)
class MapperConfig:
    """Parameters of frame registration, pose graph, mask fusion and footprint extraction."""

    registration: str = param("sift", "matching method: sift, xfeat, coarse_loftr or loftr")
    registration_model: str = param("", "ONNX file of the matching method's weights; none for sift")
    level_width_px: int = param(960, "images wider than this are shrunk when made level, px", 100, 10000)
    track_width_px: int = param(
        480, "images wider than this are shrunk to be tracked between keyframes, px", 100, 10000
    )
    features: int = param(2000, "features per keyframe", 50, 20000)
    feature_width_px: int = param(640, "level images wider than this are shrunk before SIFT, px", 100, 10000)
    match_ratio: float = param(0.8, "nearest to second-nearest descriptor distance (ratio test)", 0.1, 1.0)
    ransac_threshold_m: float = param(1.0, "inlier distance of the RANSAC similarity, m", 0.01, 100.0)
    refined_threshold_px: float = param(2.5, "inlier distance after sub-pixel refinement, px", 0.1, 100.0)
    min_inliers: int = param(20, "fewest RANSAC inliers of an accepted pair", 3, 10000)
    max_scale_deviation: float = param(0.15, "largest deviation of a pair's metric scale from 1", 0.001, 0.9)
    max_yaw_deviation_deg: float = param(
        180.0, "largest deviation of a pair's turn from the gimbal's, deg; 180: not compared", 0.1, 180.0
    )
    fallback_keyframes: int = param(3, "earlier keyframes tried when the previous one fails", 0, 100)
    skip_links: int = param(1, "keyframes before the one it is linked to that a keyframe links to", 0, 100)
    loop_radius_m: float = param(40.0, "distance at which keyframes are tested as loop closures, m", 0.0, 1e4)
    loop_gap: int = param(6, "fewest keyframes between the two ends of a loop closure", 2, 10000)
    loop_tests: int = param(2, "loop closures and joins of submaps tested per keyframe", 0, 100)
    sigma_position_m: float = param(0.5, "standard deviation of a link's translation, m", 0.001, 100.0)
    sigma_rotation_deg: float = param(0.3, "standard deviation of a link's rotation, deg", 0.001, 45.0)
    sigma_log_scale: float = param(0.01, "standard deviation of a link's log scale", 1e-5, 1.0)
    sigma_heading_deg: float = param(
        2.0, "standard deviation of the gimbal's turn between two keyframes, deg", 0.01, 180.0
    )
    altitude_noise: float = param(
        0.02, "standard deviation of the altimeter's reading, relative to the height", 1e-5, 1.0
    )
    altitude_drift: float = param(
        0.001, "standard deviation of the altimeter's drift after 1 s, relative to the height", 0.0, 1.0
    )
    altitude_bias: float = param(
        0.03, "standard deviation of the altimeter's constant error, relative to the height", 0.0, 1.0
    )
    loop_weight: float = param(2.0, "weight of a loop closure relative to a consecutive link", 0.01, 100.0)
    huber_k: float = param(
        1.345, "residual in standard deviations where the Huber loss turns linear", 0.1, 10.0
    )
    map_gsd_m: float = param(0.25, "ground sampling distance of the fused map, m", 0.05, 5.0)
    min_observations: int = param(2, "fewest keyframes that must see a building pixel", 1, 100)
    min_share: float = param(0.5, "more than this share of a pixel's views must call it building", 0.0, 0.99)
    redraw_px: float = param(
        0.5, "a keyframe that moved more than this is drawn anew, map pixels", 0.0, 100.0
    )
    max_redraws: int = param(3, "moved keyframes drawn anew per keyframe; the others follow", 0, 100000)
    max_stale_m: float = param(
        10.0, "keyframes that moved more than this are drawn anew at once, however many, m", 0.0, 1e6
    )
    sigma_centroid_m: float = param(
        0.5, "standard deviation of a centroid in one keyframe, before any was compared, m", 0.001, 100.0
    )
    min_area_m2: float = param(20.0, "smallest building of the map, m2", 0.0, 1e5)
    simplify_m: float = param(0.5, "tolerance that takes the pixel stairs out of an outline, m", 0.0, 10.0)
