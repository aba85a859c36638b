"""The scoring of networks: labels land where they belong, frames too, known ground is refused."""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from buildloc_eval.bars import Judged, bar_table
from buildloc_eval.cli import add_eval_arguments, run_eval
from buildloc_eval.flight import FlightConfig
from buildloc_eval.observation import Sensing, sensing
from buildloc_eval.overlapping import SceneSurface, Seen, centres, frame, overlap
from buildloc_eval.overlays import overlay, rim, windows
from buildloc_eval.places import Scene, patches
from buildloc_eval.places import overlap as share_ground
from buildloc_eval.segmentation import (
    KINDS,
    Case,
    EvaluationError,
    parity,
    parse_case,
    refuse_known_ground,
    table,
)
from buildloc_eval.segmentation_bars import case_bars, speed_bars
from buildloc_eval.segmentation_errors import read_errors
from buildloc_eval.segmented import busiest, disturbed, find, score
from buildloc_msgs_py.errors import BuildlocError
from buildloc_segmenter.instances import Instances, find_instances
from buildloc_segmenter.tiles import Block, blocks

NETWORK_GSD_M = 0.25
CLEAN = FlightConfig(exposure=0.0, blur_px=0.0, noise=0.0)


class Bright:
    """A network that takes what is bright for building, in blocks of the image."""

    def instances(self, image: np.ndarray, gsd_m: float) -> Instances:
        size = [max(1, round(side * gsd_m / NETWORK_GSD_M)) for side in image.shape[:2]]
        rows, columns = (
            ((np.arange(n) + 0.5) * full / n).astype(int)
            for n, full in zip(size, image.shape[:2], strict=True)
        )
        logits = np.where(image[np.ix_(rows, columns)][:, :, 0] > 127, 4.0, -4.0).astype(np.float32)
        return find_instances(logits, None, NETWORK_GSD_M, 8.0, 0.5, gsd_m)

    def blocks(self, image: np.ndarray, gsd_m: float) -> Iterator[tuple[Block, Instances]]:
        for block in blocks(*image.shape[:2], round(90.0 / gsd_m), round(30.0 / gsd_m)):
            found = self.instances(image[block.rows, block.columns], gsd_m)
            own = block.own_in_window(gsd_m / NETWORK_GSD_M)
            kept = [0]
            for number in range(1, len(found) + 1):
                r, c = (v.mean() for v in np.nonzero(found.labels == number))
                kept.append(number * (own[0] <= c < own[2] and own[1] <= r < own[3]))
            yield block, replace(found, labels=np.array(kept, dtype=np.int32)[found.labels])

    def segment(self, image: np.ndarray, gsd_m: float) -> np.ndarray:
        return np.where(image[:, :, 0] > 127, 255, 0).astype(np.uint8)


BRIGHT: Any = Bright()  # what is scored needs no more of a network


def village(height_m: float = 160.0, width_m: float = 220.0, gsd_m: float = 0.4) -> Scene:
    """Houses of 12 m every 25 m, bright on dark ground."""
    shape = (round(height_m / gsd_m), round(width_m / gsd_m))
    buildings = np.zeros(shape, dtype=np.int32)
    places = [(r, c) for r in np.arange(8.0, height_m - 20, 25) for c in np.arange(8.0, width_m - 20, 25)]
    for number, (r, c) in enumerate(places, start=1):
        buildings[round(r / gsd_m) : round((r + 12) / gsd_m), round(c / gsd_m) : round((c + 12) / gsd_m)] = (
            number
        )
    rgb = np.repeat(np.where(buildings > 0, 220, 40).astype(np.uint8)[:, :, None], 3, axis=2)
    return Scene("village", gsd_m, rgb, buildings, np.ones(shape, dtype=np.bool_))


def test_the_blocks_of_a_scene_are_laid_together_on_the_raster_of_the_truth() -> None:
    scored = score(BRIGHT, village())
    for result in (scored.instances, scored.plain, scored.wire, scored.mapped):
        assert len(result.true) == len(result.found) == result.true.matched_strict.sum()
        assert not result.true.merged.any() and not result.true.split.any()
        assert np.abs(result.pairs.centroid_m).max() < 0.15
        assert result.pixels[0] / result.pixels.sum() > 0.95


def test_a_wrong_altitude_moves_no_building() -> None:
    scene = village()
    results = {kind.name: result for kind, result in disturbed(BRIGHT, scene)}
    assert len(results) == 6
    for result in results.values():
        assert result.true.matched_strict.all() and np.abs(result.pairs.centroid_m).max() < 0.4
    finds = find(BRIGHT, scene.rgb, 1.3 * scene.gsd_m, scene.labelled.shape)
    assert (finds.plain > 0).mean() == pytest.approx((scene.buildings > 0).mean(), rel=0.1)


def test_a_frame_lies_where_it_was_taken_whatever_its_heading_and_tilt() -> None:
    scene = village(400.0, 420.0).resampled(0.2)
    surface, places = SceneSurface(scene), dict(centres(scene, CLEAN))
    assert {(0, 0), (0, 1), (1, 0)} <= places.keys()
    seen = {
        cell: frame(BRIGHT, surface, scene, places[cell], CLEAN, np.random.default_rng(cell))
        for cell in ((0, 0), (0, 1))
    }
    one = seen[(0, 0)]
    true = scene.buildings[one.rows, one.columns] > 0
    assert ((one.found > 0) == true)[one.covered].mean() > 0.985
    both = overlap(scene, one, seen[(0, 1)])
    assert both is not None and both.both >= 2 and both.one == both.neither == both.false == 0
    assert np.abs(both.apart_m).max() < 0.3
    # The second frame loses its first building: found in one alone.
    number = np.bincount(seen[(0, 1)].found[seen[(0, 1)].covered])
    lost = replace(seen[(0, 1)], found=np.zeros_like(seen[(0, 1)].found))
    assert number[1:].any()
    alone = overlap(scene, one, lost)
    assert alone is not None and alone.one == both.both and alone.both == 0


def test_frames_apart_do_not_overlap() -> None:
    scene = village()
    empty = np.zeros((10, 10), dtype=np.int32)
    first, second = (Seen(slice(at, at + 10), slice(0, 10), empty, empty == 0) for at in (0, 50))
    assert overlap(scene, first, second) is None


def test_the_busiest_square_and_the_patches_of_a_scene() -> None:
    scene = village()
    built = np.zeros_like(scene.buildings)
    built[200:260, 300:360] = 1
    square = busiest(replace(scene, buildings=built), 40.0)
    assert square.labelled.shape == (100, 100) and (square.buildings > 0).sum() == 3600
    labelled = np.zeros_like(scene.labelled)
    labelled[:100, :100], labelled[200:, 300:400] = True, True
    parts = patches(replace(scene, labelled=labelled))
    assert [part.labelled.shape for part in parts] == [(100, 100), (200, 100)]
    assert (parts[1].buildings == scene.buildings[200:, 300:400]).all()
    assert [part.name for part in patches(scene)] == ["village"]


def test_pictures_show_the_drawn_and_the_worst_and_both_outlines() -> None:
    scene = village()
    missing = replace(scene, rgb=np.where(scene.buildings[:, :, None] == 5, 40, scene.rgb).astype(np.uint8))
    scored = score(BRIGHT, missing)
    shown = windows(scored, 1)
    assert [name for name, _ in shown] == ["drawn by the seed"] * 3 + ["missed, 144 m2"]
    picture = overlay(scored, shown[-1][1])
    assert picture.shape[0] == picture.shape[1]
    green = (picture == (60, 220, 60)).all(axis=2).sum()
    assert green > 4 * 100  # no find covers the outline of the missed one
    assert rim(np.pad(np.ones((3, 3), dtype=np.int32), 1)).sum() == 8


def test_a_network_is_not_scored_on_ground_that_trained_it() -> None:
    training: dict[str, Any] = {"places": ["zanzibar", "barnarp_west"]}
    for place in ("barnarp", "barnarp_west", "zanzibar"):
        with pytest.raises(EvaluationError, match="was trained on"):
            refuse_known_ground(Case(place, "net.onnx"), training)
    refuse_known_ground(Case("barnarp_east", "net.onnx"), training)
    refuse_known_ground(Case("zanzibar", "net.onnx"), None)
    assert share_ground("barnarp", "barnarp_east") and not share_ground("barnarp_west", "barnarp_east")


def test_cases_and_options_are_told_apart() -> None:
    assert parse_case("barnarp=a=b.onnx") == Case("barnarp", "a=b.onnx")
    with pytest.raises(EvaluationError, match="expected PLACE=MODEL"):
        parse_case("barnarp")
    parser = argparse.ArgumentParser()
    add_eval_arguments(parser)
    assert parser.parse_args(["scale", "--out", "x", "--levels", "2", "measured"]).levels == [2, "measured"]
    with pytest.raises(BuildlocError, match="of `eval segmentation`, not of `eval scale`"):
        run_eval(parser.parse_args(["scale", "--out", "x", "--case", "barnarp=net.onnx"]))
    with pytest.raises(BuildlocError, match="--levels is of `eval scale`"):
        run_eval(parser.parse_args(["segmentation", "--out", "x", "--levels", "1"]))


def test_the_measured_level_is_that_of_the_shipped_error_model() -> None:
    errors, level = read_errors(), sensing("measured")
    assert isinstance(level, Sensing) and level.jitter_m == errors.centroid_sigma_m
    assert 0.0 < errors.missed < level.missed < 1.0 and level.shape_sigma == errors.shape_sigma
    assert level.heading_walk_deg == sensing(1).heading_walk_deg
    assert 0.0 <= errors.never_found <= errors.missed


def test_the_table_has_a_row_for_each_scene_and_way_of_counting() -> None:
    values: dict[str, Any] = dict.fromkeys(
        ("pixel_iou", "pixel_f1", "recall_0.5", "precision_0.5", "recall_0.3", "precision_0.3", "merged",
         "split", "missed", "centroid_median_m", "outline_m", "false_per_km2"), 0.5,
    )  # fmt: skip
    kinds: dict[str, Any] = dict.fromkeys(KINDS, values | {"centroid_p90_m": None})
    kinds |= {"merged over plain": 0.25}
    report = {
        "place": "banepa", "model": "net.onnx", "trained on": [{"places": ["zanzibar"]}], "all scenes": kinds,
        "scenes": {"a": kinds, "b": kinds},
        "disturbed input": {"as it comes": {"pixel_iou": 0.7}, "low": {"pixel_iou": 0.6, "falls_by": 0.1}},
    }  # fmt: skip
    text = table([report])
    assert text.startswith("imagery: real") and text.count("banepa, ") == 12
    assert text.count("merged over plain: 0.25") == 3
    assert "low: IoU 0.600, falls by 0.100" in text and "zanzibar" in text


def test_what_a_map_leaves_out_counts_for_nothing_in_its_row() -> None:
    scene = village()
    sheds = scene.buildings.copy()
    sheds[60:70, 60:70] = sheds.max() + 1  # 16 m2 that nobody finds
    scored = score(BRIGHT, replace(scene, buildings=sheds))
    assert scored.wire.true.lost.sum() == 1 and not scored.mapped.true.lost.any()


def case_report(place: str, trained: list[str], **figures: float) -> dict[str, Any]:
    """The part of a report that is judged: all figures good but those given."""
    good = {"pixel_iou": 0.9, "recall_0.3": 0.98, "precision_0.3": 0.95, "centroid_median_m": 0.3,
            "centroid_p90_m": 1.0}  # fmt: skip
    return {
        "place": place, "model": "net.onnx", "trained on": [{"places": trained}],
        "all scenes": {"instances": good | figures},
        "scenes": {"banepa_ortho": {"merged over plain": figures.get("merged", 0.3)}},
        "disturbed input": {"as it comes": {"pixel_iou": 0.7}, "low": {"falls_by": figures.get("fall", 0.01)},
                            "high": {"falls_by": -0.01}},
        "torch against onnx": {"equal_mask_share": 0.9995},
    }  # fmt: skip


def missed(bars: Judged) -> list[str]:
    return [what.split(": ")[-1] for what, bar in bars.items() if not bar["held"]]


def test_a_network_is_judged_by_the_bars_of_its_place() -> None:
    assert len(case_bars(case_report("barnarp", ["banepa"]))) == 6
    assert not missed(case_bars(case_report("barnarp", ["banepa"])))
    weak = {"precision_0.3": 0.79, "centroid_median_m": 0.81, "fall": 0.06}
    fell = "IoU of disturbed input falls by"
    assert missed(case_bars(case_report("barnarp", ["banepa"], **weak))) == [*list(weak)[:2], fell]
    # The east half asks for more of a network that has seen the west half.
    for trained, asked in ((["banepa"], []), (["banepa", "barnarp_west"], ["recall_0.3", "centroid_p90_m"])):
        report = case_report("barnarp_east", trained, **{"recall_0.3": 0.9, "centroid_p90_m": 2.0})
        assert missed(case_bars(report)) == asked
    assert missed(case_bars(case_report("banepa", ["zanzibar"], merged=0.4))) == ["merged over plain"]
    assert [
        bar.get("at most", bar.get("at least")) for bar in case_bars(case_report("zanzibar", [])).values()
    ] == [0.05, 0.999]
    nothing = case_report("barnarp", []) | {"torch against onnx": None}
    nothing["all scenes"]["instances"]["centroid_median_m"] = None
    assert missed(case_bars(nothing)) == ["centroid_median_m"]
    assert bar_table(case_bars(nothing)).count("MISSED") == 1


def test_the_quantised_network_has_its_own_bar_of_time() -> None:
    one: dict[str, Any] = {"ms_total": 60.0, "peak_memory_mb": 300.0, "quantised": False}
    speeds = {"load average": 0.1, "frame": "1280x720", "shipped": one, "int8": one | {"quantised": True}}
    assert missed(speed_bars(speeds)) == ["ms a frame"] and len(speed_bars(speeds)) == 4


def test_the_agreement_with_pytorch_is_that_of_the_export(tmp_path: Path) -> None:
    assert parity(tmp_path / "model.onnx") is None
    (tmp_path / "export.json").write_text(json.dumps({"torch_against_onnx": {"equal_mask_share": 1.0}}))
    assert parity(tmp_path / "model.onnx") == {"equal_mask_share": 1.0}
    assert parity(tmp_path / "model_int8.onnx") is None  # it was not what was compared
    (tmp_path / "export.json").write_text("{}")
    with pytest.raises(EvaluationError, match="export the network again"):
        parity(tmp_path / "model.onnx")
