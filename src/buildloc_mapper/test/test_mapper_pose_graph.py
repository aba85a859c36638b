"""The pose graph on drawn paths: loops, lies, altimeters and gimbals; incremental is batch."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from buildloc_mapper.config import MapperConfig
from buildloc_mapper.pose_graph import Edge, PoseGraph, Turn
from buildloc_mapper.registration import Link, link_covariance
from buildloc_mapper.similarity import Similarity

CONFIG = MapperConfig()
ORIGIN = Similarity(0.0, 0.0, 0.0, 1.0)
NO_NOISE = np.zeros((4, 4))
SECOND = 10**9
HALF_A_LINK = 0.5 * np.array(
    [
        CONFIG.sigma_position_m, CONFIG.sigma_position_m,
        math.radians(CONFIG.sigma_rotation_deg), CONFIG.sigma_log_scale,
    ]
) * math.sqrt(CONFIG.min_inliers / 60)  # fmt: skip


def edge(earlier: int, later: int, transform: Similarity, inliers: int = 60, loop: bool = False) -> Edge:
    covariance = link_covariance(Link(transform, inliers, NO_NOISE), CONFIG)
    return Edge(earlier, later, transform, inliers, covariance, loop)


def chained(edges: list[Edge], config: MapperConfig = CONFIG) -> PoseGraph:
    """Keyframes 5 s apart, in order, each added with its links to those before."""
    graph = PoseGraph(config)
    graph.add(0, 0, ORIGIN, [])
    for later in range(1, max(e.later for e in edges) + 1):
        own = [e for e in edges if e.later == later]
        graph.add(later, later * 5 * SECOND, graph.poses[own[0].earlier].compose(own[0].transform), own)
    return graph


def noisy(transform: Similarity, rng: np.random.Generator, spread: tuple[float, ...]) -> Similarity:
    x, y, yaw, scale = rng.normal(size=4) * spread
    return Similarity(
        transform.x_m + x, transform.y_m + y, transform.yaw_rad + yaw, transform.scale * math.exp(scale)
    )


def laps(seed: int, count: int = 60) -> tuple[list[Similarity], list[Edge]]:
    """Two laps of a bent circle: true poses, and noisy links to the last, the one before it, and to those
    of the lap before that are near."""
    rng = np.random.default_rng(seed)
    angles = np.linspace(0.0, 2 * math.tau, count)
    places = np.column_stack([200 * np.cos(angles), 120 * np.sin(angles) + 30 * np.sin(3 * angles)])
    truth = [Similarity(x, y, rng.uniform(-3, 3), 1.0) for x, y in places]
    to_first = truth[0].inverse()
    truth = [to_first.compose(pose) for pose in truth]
    spread = (0.2, 0.2, 0.003, 0.004)
    pairs = [(i - back, i, False) for i in range(1, count) for back in (1, 2) if i >= back]
    pairs += [(i - count // 2, i, True) for i in range(count // 2, count, 3)]
    edges = [
        edge(a, b, noisy(truth[a].inverse().compose(truth[b]), rng, spread), int(rng.integers(25, 200)), loop)
        for a, b, loop in pairs
    ]
    return truth, sorted(edges, key=lambda e: (e.later, e.later - e.earlier))


def apart(one: dict[int, Similarity], other: dict[int, Similarity]) -> np.ndarray:
    """(4,) largest differences in x, y, yaw and scale."""
    difference = np.array([one[k] for k in one]) - np.array([other[k] for k in one])
    difference[:, 2] = np.remainder(difference[:, 2] + math.pi, math.tau) - math.pi
    return np.abs(difference).max(axis=0)


@pytest.mark.parametrize("seed", range(4))
def test_incremental_and_batch_agree_on_flights_with_loops(seed: int) -> None:
    _, edges = laps(seed)
    gaussian = chained(edges, replace(CONFIG, huber_k=10.0))  # no residual reaches the bend of the loss
    assert (apart(gaussian.poses, gaussian.batch()) < [1e-3, 1e-3, 1e-5, 1e-5]).all()
    # Huber's weights are renewed only where a keyframe moves: what is left is below half a link's sigmas.
    graph = chained(edges)
    assert (apart(graph.poses, graph.batch()) < HALF_A_LINK).all()


def test_loop_closures_take_most_of_the_drift_out() -> None:
    truth, edges = laps(7)
    flown = chained(edges)
    blind = chained([e for e in edges if not e.loop])

    def error(graph: PoseGraph) -> float:
        return float(np.mean([math.dist(graph.poses[i][:2], truth[i][:2]) for i in range(len(truth))]))

    assert error(flown) < 0.6 * error(blind)
    # Seen from the start, a keyframe that was just tied to the first lap is surer than one that was not.
    last = len(truth) - 1
    assert flown.place_sigma_m(last) < 0.7 * blind.place_sigma_m(last)


@pytest.mark.parametrize("seed", range(3))
def test_two_false_loop_closures_of_ten_change_little(seed: int) -> None:
    truth, edges = laps(seed)
    rng = np.random.default_rng(seed + 50)
    loops = [i for i, e in enumerate(edges) if e.loop]
    false = list(edges)
    for i in rng.permutation(loops)[:2]:
        false[i] = replace(edges[i], transform=noisy(edges[i].transform, rng, (20.0, 20.0, 0.5, 0.05)))

    def rmse(graph: PoseGraph) -> float:
        off = [math.dist(graph.poses[i][:2], truth[i][:2]) for i in range(len(truth))]
        return float(np.sqrt(np.mean(np.square(off))))

    assert rmse(chained(false)) < rmse(chained(edges)) + 0.5  # a link's own sigma, in metres


def test_the_told_uncertainty_of_a_place_is_that_of_many_flights() -> None:
    """Links with the noise that the graph is told, and no other: errors over sigma are those of a normal."""
    rng, over = np.random.default_rng(5), []
    config = replace(CONFIG, altitude_noise=1e-3, altitude_drift=0.0)
    step, sigma = Similarity(20.0, 0.0, 0.1, 1.0), np.array([0.3, 0.1, 0.005, 0.002])
    for _ in range(60):
        graph = PoseGraph(config)
        graph.add(0, 0, ORIGIN, [])
        true = ORIGIN
        for i in range(1, 12):
            link = Edge(i - 1, i, noisy(step, rng, tuple(sigma)), 60, np.diag(sigma**2))
            graph.add(i, i * SECOND, graph.poses[i - 1].compose(link.transform), [link])
            true = true.compose(step)
        # The larger axis of the ellipse is told: the error along any axis is below it.
        over.append(math.dist(graph.poses[11][:2], true[:2]) / graph.place_sigma_m(11))
    assert 0.6 < np.sqrt(np.mean(np.square(over))) < math.sqrt(2.0)


def test_a_covariance_of_the_fit_moves_the_map_less_where_it_is_unsure() -> None:
    """Two links disagree across the path alone; the one that is unsure across gives way."""
    sure, unsure = np.diag([1e-4] * 4), np.diag([1e-4, 100.0, 1e-4, 1e-4])
    first, second = Similarity(10.0, 0.0, 0.0, 1.0), Similarity(10.0, 2.0, 0.0, 1.0)
    graph = PoseGraph(CONFIG)
    graph.add(0, 0, ORIGIN, [])
    graph.add(1, SECOND, first, [Edge(0, 1, first, 60, sure), Edge(0, 1, second, 60, unsure)])
    assert abs(graph.poses[1].y_m) < 0.05
    turned = Similarity(10.0, 0.0, math.pi / 2, 1.0)  # the covariance is that of the earlier keyframe's axes
    graph.add(2, 2 * SECOND, graph.poses[1].compose(turned), [
        Edge(1, 2, turned, 60, sure), Edge(1, 2, turned._replace(y_m=2.0), 60, unsure),
    ])  # fmt: skip
    assert abs(graph.poses[2].y_m - graph.poses[1].y_m) < 0.05


def test_one_link_that_lies_moves_a_keyframe_by_no_more_than_its_weight() -> None:
    step = Similarity(5.0, 0.0, 0.0, 1.0)
    edges = [edge(i, i + 1, step) for i in range(4)] + [edge(0, 2, Similarity(40.0, 0.0, 0.0, 1.0), 20)]
    # Huber bounds the pull of the outlier (30 m off) to about what its weight allows.
    assert abs(chained(edges).poses[2].x_m - 10.0) < 2.0


def test_links_that_grow_are_pulled_to_the_altimeter() -> None:
    edges = [edge(i, i + 1, Similarity(10.0, 0.0, 0.0, 1.02)) for i in range(10)]
    grown = 1.02**10
    assert 1.0 < chained(edges).poses[10].scale < 1.0 + 0.5 * (grown - 1.0)
    loose = replace(CONFIG, altitude_noise=0.3, altitude_drift=0.3)
    assert chained(edges, loose).poses[10].scale > 1.0 + 0.5 * (grown - 1.0)


def test_scale_of_the_map_is_the_mean_of_the_altimeter_not_its_first_reading() -> None:
    """The first reading is 8 % too small, so seen from it all others are too far; the rest outvotes it."""
    edges = [edge(0, 1, Similarity(10.0 / 1.08, 0.0, 0.0, 1.0 / 1.08), 400)]
    edges += [edge(i, i + 1, Similarity(10.0, 0.0, 0.0, 1.0), 400) for i in range(1, 12)]
    poses = chained(edges).poses
    assert poses[0].scale == pytest.approx(1.08, abs=0.02)
    assert poses[12].x_m == pytest.approx(120.0, rel=0.02)


def test_a_drifting_altimeter_is_followed_and_a_noisy_one_is_not() -> None:
    """The links say that nothing changes; readings of the altimeter are in the links' scales."""
    rng, count = np.random.default_rng(2), 80

    def spread(log_scales: np.ndarray) -> float:
        """How far true sizes are from constant once the readings' errors are in the links."""
        edges = [
            edge(i, i + 1, Similarity(10.0, 0.0, 0.0, math.exp(log_scales[i + 1] - log_scales[i])), 400)
            for i in range(count - 1)
        ]
        poses = chained(edges).poses
        left = np.log([poses[i].scale for i in range(count)]) - log_scales
        return float(np.std(left))

    noise = rng.normal(0.0, 0.02, count)
    assert spread(noise) < 0.2 * noise.std()
    drift = np.linspace(0.0, 0.04, count)  # 4 % over 400 s; the walk's own sigma there is 2 %
    assert spread(drift) < 0.5 * drift.std()


def test_the_uncertainty_of_scale_never_falls_below_the_bias_that_no_image_can_tell() -> None:
    _, edges = laps(1)
    graph = chained(edges)
    assert 0.03 <= graph.scale_sigma(59) < 0.05
    assert graph.scale_sigma(1) > CONFIG.altitude_bias
    biased = chained(edges, replace(CONFIG, altitude_bias=0.1))
    assert biased.scale_sigma(59) > 0.1
    assert apart(biased.poses, graph.poses).max() == 0.0


def test_the_gimbals_turn_steadies_a_chain_and_a_wrong_one_cannot_turn_it() -> None:
    def flown(turn_rad: float) -> float:
        graph = PoseGraph(replace(CONFIG, sigma_heading_deg=0.2))
        graph.add(0, 0, ORIGIN, [])
        for i in range(1, 30):
            turned = Similarity(10.0, 0.0, math.radians(0.5), 1.0)  # each link is off by half a degree
            turns = [Turn(i - 1, i, turn_rad)]
            graph.add(i, i * SECOND, graph.poses[i - 1].compose(turned), [edge(i - 1, i, turned)], turns)
        return math.degrees(graph.poses[29].yaw_rad)

    assert flown(0.0) < 0.8 * 29 * 0.5
    assert flown(math.radians(90.0)) < 1.5 * 29 * 0.5


def test_two_graphs_are_joined_in_the_frame_of_the_first() -> None:
    _, edges = laps(3)
    whole = chained(edges)
    cut = 30
    one = chained([e for e in edges if e.later < cut])
    other = PoseGraph(CONFIG)
    other.add(cut, cut * 5 * SECOND, ORIGIN, [])
    for later in range(cut + 1, 60):
        own = [e for e in edges if e.later == later and e.earlier >= cut]
        other.add(later, later * 5 * SECOND, other.poses[own[0].earlier].compose(own[0].transform), own)
    between = [e for e in edges if e.earlier < cut <= e.later]
    link = between[-1]
    guess = one.poses[link.earlier].compose(link.transform).compose(other.poses[link.later].inverse())
    both = one.joined(other, guess, between)
    assert list(both.poses) == list(range(60))
    assert (apart(both.poses, whole.batch()) < HALF_A_LINK).all()
    both.add(60, 300 * SECOND, both.poses[59], [edge(59, 60, ORIGIN)])
    assert both.poses[60].x_m == pytest.approx(both.poses[59].x_m, abs=0.05)
