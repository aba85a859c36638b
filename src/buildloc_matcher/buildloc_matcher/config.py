"""Every parameter of the matcher, with its unit, default and range."""

from __future__ import annotations

from dataclasses import dataclass

from buildloc_msgs_py.config import param


@dataclass(frozen=True)
class MatcherConfig:
    """Parameters of descriptor matching, voting, selection, refinement and acceptance."""

    min_area_m2: float = param(20.0, "smallest footprint used, reference and query alike, m2", 0.0, 1e5)
    tau_angle_deg: float = param(15.0, "tolerance on the L1 distance of the sorted angles, deg", 0.1, 180.0)
    tau_perimeter: float = param(0.3, "tolerance on the relative perimeter difference", 0.01, 0.95)
    tau_shape: float = param(0.3, "tolerance on the mean shape difference", 0.01, 1.0)
    matches_per_star: int = param(50, "best reference matches kept per query star", 1, 10000)
    scale_gate: float = param(0.15, "largest deviation of the map-to-world scale from 1", 0.0, 0.9)
    bin_size_m: float = param(100.0, "side of a voting bin, m", 1.0, 10000.0)
    rotation_tolerance_deg: float = param(
        10.0, "half width of a rotation-consistent cluster, deg", 0.1, 180.0
    )
    min_votes: int = param(3, "fewest rotation-consistent votes of a candidate", 1, 10000)
    top_k: int = param(20, "candidates rescored by MNN-Jaccard", 1, 1000)
    polish_iterations: int = param(4, "alignment steps of a candidate before it is scored; 0: none", 0, 50)
    mnn_distance_m: float = param(10.0, "largest distance of a mutual nearest-neighbour pair, m", 0.1, 1000.0)
    observable_margin_m: float = param(
        15.0, "margin around the hull of the map that was observed, m", 0.0, 1000.0
    )
    observable_radius_m: float = param(
        60.0, "ground around each map building that was observed, m", 1.0, 10000.0
    )
    refine_frames: int = param(20, "most recent keyframes used by the refinement", 1, 10000)
    refine_distance_m: float = param(50.0, "1-NN distance of the first refinement step, m", 0.1, 1000.0)
    refine_last_distance_m: float = param(15.0, "1-NN distance of the last refinement step, m", 0.1, 1000.0)
    refine_iterations: int = param(6, "refinement steps while the distance shrinks", 1, 100)
    min_buildings: int = param(12, "fewest buildings in the map for a fix", 3, 100000)
    min_jaccard: float = param(0.35, "smallest MNN-Jaccard of an accepted candidate", 0.0, 1.0)
    max_log10_false_alarm: float = param(
        -3.0, "log10 of the chance matches expected in the whole reference", -300.0, 10.0
    )
    min_lead: float = param(1.3, "smallest MNN-Jaccard ratio to the best candidate elsewhere", 1.0, 100.0)
    rival_distance_m: float = param(200.0, "candidates further away than this are elsewhere, m", 0.0, 1e6)
    min_pairs: int = param(10, "fewest distinct reference buildings matched for a fix", 3, 100000)
    max_residual_m: float = param(10.0, "largest RMS distance of the matched pairs for a fix, m", 0.1, 1000.0)
    sigma_floor_m: float = param(3.0, "smallest horizontal standard deviation reported, m", 0.1, 1000.0)
    sigma_inflation: float = param(2.0, "factor on the residual-based standard deviation", 1.0, 100.0)
    sigma_up_m: float = param(100.0, "standard deviation reported for the altitude, m", 0.1, 10000.0)
