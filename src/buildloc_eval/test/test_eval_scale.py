"""The benchmark of the matcher: its maps have the errors they claim, its rivals work, its figures add up."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from buildloc_eval import scale
from buildloc_eval.generators import full_vector, nearest_stars, shapeless_vector
from buildloc_eval.observation import Digitiser, ObservationError, Sensing, observe_map, sensing
from buildloc_eval.realworld import DataError, data_folder
from buildloc_eval.scale import Plan, Size
from buildloc_eval.trials import Trial, summary
from buildloc_matcher.config import matcher_config
from buildloc_matcher.matching import QueryStars
from buildloc_matcher.reference.buildings import Buildings
from buildloc_matcher.reference.database import assemble
from scipy.spatial import cKDTree

SAME = Digitiser(0.0, 0.0, 1e-9, 0.0, 0.0, (0.0, 0.0, 0.0, 0.0))
PERFECT = Sensing(0.0, 0.0, 0.0, 0.0, 0.0)


def town(count: int = 4000, side_m: float = 2500.0) -> Buildings:
    rng = np.random.default_rng(3)
    areas = np.exp(rng.normal(5.0, 0.5, count)).astype(np.float32)
    shapes = rng.uniform(0.5, 1.0, (count, 4)).astype(np.float32)
    return Buildings(np.add(rng.uniform(0.0, side_m, (count, 2)), (330_000.0, 4_700_000.0)), areas, shapes)


def test_a_map_without_errors_is_a_rigid_copy_of_the_buildings_along_the_path() -> None:
    reference = town()
    observed = observe_map(
        reference, cKDTree(reference.centroids_m), 50, PERFECT, np.random.default_rng(1), SAME
    )
    local, true = observed.local_map.centroids_m, observed.true_m
    assert len(local) == 50 and observed.local_map.areas_m2.min() > 0.0
    distances = np.linalg.norm(local[:, None] - local[None], axis=2)
    np.testing.assert_allclose(distances, np.linalg.norm(true[:, None] - true[None], axis=2), atol=1e-6)
    nearest, _ = cKDTree(reference.centroids_m).query(true)
    assert nearest.max() < 1e-6
    # The truth of the map's middle is the mean of the true places where nothing bends.
    np.testing.assert_allclose(observed.centre_m, true.mean(axis=0), atol=1e-6)


def test_errors_of_a_level_are_those_it_states() -> None:
    reference = town()
    tree = cKDTree(reference.centroids_m)
    level = sensing(2)
    assert (level.missed, level.false, level.jitter_m) == (0.24, 0.16, 2.4)
    alone, apart = [], []
    for seed in range(30):
        observed = observe_map(reference, tree, 100, level, np.random.default_rng(seed))
        nearest, _ = tree.query(observed.true_m)
        alone.append((nearest > 12.0).mean())
        apart.extend(nearest[nearest < 3.0])
    # 21 % of the world and 16 % of what is seen are not in the reference; in a town this dense some of the
    # invented ones fall close to a building all the same.
    share = 1.0 - (1.0 - 0.21) * (1.0 - 0.16)
    far = math.exp(-len(reference) / 2500.0**2 * math.pi * 12.0**2)
    assert np.mean(alone) == pytest.approx(share * far, abs=0.03)
    assert np.median(apart) == pytest.approx(0.6, abs=0.15)


def test_too_few_buildings_for_a_map_are_an_error() -> None:
    few = town(40)
    with pytest.raises(ObservationError, match="ask for fewer"):
        observe_map(few, cKDTree(few.centroids_m), 500, PERFECT, np.random.default_rng(0))


def test_a_star_is_its_own_nearest_neighbour_and_its_vectors_are_right_by_hand() -> None:
    database = assemble(32619, town(), matcher_config())
    tile = database.tiles[0]
    features = tile.triangles.star_features()
    for encode, width in ((full_vector, 32), (shapeless_vector, 8)):
        assert encode(features[:3]).shape == (3, width)
        rows = np.arange(0, 400, 37)
        stars = QueryStars(features[rows], np.zeros((len(rows), 3), dtype=np.float32))
        found = nearest_stars(encode, database)(database.tables, matcher_config()).match(stars)
        assert (found.reference[:, 0] == rows).all() and found.score[:, 0] == pytest.approx(1.0, abs=1e-3)
    # The 3-4-5 triangle: area 6, perimeter 12.
    right = np.zeros((1, 4, 8), dtype=np.float32)
    right[:, :, :4] = (math.asin(0.6), math.asin(0.8), 1.0, 12.0)
    assert shapeless_vector(right)[0, :2] == pytest.approx([math.log(6.0), math.log(144.0)], abs=1e-5)
    assert full_vector(right)[0, 2] == pytest.approx(math.pi / 2.0, abs=1e-6)


def test_the_summary_counts_ranks_and_false_fixes() -> None:
    seconds = {"match": 0.010, "select": 0.005}
    trials = [
        Trial(1, 2.0, True, seconds),
        Trial(1, 4.0, False, seconds),
        Trial(3, 500.0, False, seconds),
        Trial(0, 900.0, True, seconds),
    ]
    figures = summary(trials)
    assert (figures["recall@1"], figures["recall@5"], figures["recall@10"]) == (0.5, 0.75, 0.75)
    assert figures["median_error_m"] == 3.0 and figures["false_fixes"] == 1 and figures["fixes"] == 0.5
    assert figures["ms_total"] == pytest.approx(15.0)
    low, high = figures["recall@1_95%"]
    assert low < 0.5 < high


@pytest.mark.data
def test_a_small_run_on_real_footprints_writes_its_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    try:
        data_folder()
    except DataError as error:
        pytest.skip(str(error))
    sizes = (Size("2 km", 2.0), Size("5 km", 5.0))
    monkeypatch.setattr(scale, "QUICK", Plan(sizes, (60, 100), (1,), 4, 3, ("paper",), 1))
    monkeypatch.setattr(scale, "TIMED", "5 km")
    printed = scale.evaluate(tmp_path, 1, True, lambda _: None)
    report = json.loads((tmp_path / "report.json").read_text())
    assert report["references"]["5 km"]["buildings"] > report["references"]["2 km"]["buildings"] > 1000
    assert report["timing at 5 km"]["default"]["equal"] and report["timing at 5 km"]["paper"]["equal"]
    assert report["maps from outside the reference"]["false fixes"] == 0
    default = [r for r in report["trials"] if r["method"] == "default" and r["level"] == 1]
    assert len(default) == 4 and all(r["false_fixes"] == 0 for r in default)
    # A few km2 and the smallest errors: anything less than all would be a defect, not bad luck.
    assert all(r["recall@1"] == 1.0 for r in default)
    assert "simulated" in printed and "simulated" in (tmp_path / "report.html").read_text()
