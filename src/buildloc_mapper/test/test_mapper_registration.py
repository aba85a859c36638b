"""Every matching method on one plane: a known similarity comes back; what cannot be registered is refused."""

from __future__ import annotations

import math
import os
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from buildloc_mapper.config import MapperConfig
from buildloc_mapper.level import level_image
from buildloc_mapper.mapper import Mapper
from buildloc_mapper.matching import Sift, fit_into, unfit
from buildloc_mapper.registration import Link, Registration, Rejection, turn_back, turn_image
from buildloc_mapper.similarity import Similarity, fit_similarity
from buildloc_mapper.xfeat import keypoints, sample
from buildloc_msgs_py.errors import BuildlocError
from buildloc_msgs_py.ground import camera_matrix, level_matrix
from buildloc_msgs_py.types import CameraModel, Frame
from onnx import TensorProto, helper, numpy_helper
from textured import CAMERA, LEVEL, shoot, tilt

DATA = Path(os.environ.get("BUILDLOC_DATA", Path(__file__).parents[4] / "shared" / "data"))
NETWORKS = ["xfeat", "coarse_loftr"]
METHODS = ["sift", *(pytest.param(name, marks=pytest.mark.data) for name in NETWORKS)]


def config_of(method: str) -> MapperConfig:
    if method == "sift":
        return MapperConfig()
    weights = DATA / "models" / f"{method}.onnx"
    if not weights.is_file():
        pytest.skip(f"no weights: {weights} is absent (set BUILDLOC_DATA)")
    return replace(MapperConfig(), registration=method, registration_model=str(weights))


def registered(earlier: Frame, later: Frame, config: MapperConfig) -> Link | Rejection:
    registration = Registration(config)
    return registration.register(registration.prepare(earlier), registration.prepare(later))


def headed(
    attitude: tuple[float, float, float, float], heading_rad: float
) -> tuple[float, float, float, float]:
    """The attitude (tilt alone) turned clockwise about the vertical."""
    (x, y, _, w), s, c = attitude, math.sin(heading_rad / 2), math.cos(heading_rad / 2)
    return c * x - s * y, c * y + s * x, s * w, c * w


FIRST = shoot(0, -50.0, 0.0, 0.3)[0]
SECOND = shoot(1, -30.0, 2.0, 0.35, 62.0, tilt(0.05, -0.03))[0]


@pytest.mark.parametrize("method", METHODS)
def test_the_relative_pose_comes_back_through_altitude_and_tilt_changes(method: str) -> None:
    link = registered(FIRST, SECOND, config_of(method))
    assert isinstance(link, Link)
    c, s = math.cos(-0.3), math.sin(-0.3)
    expected = np.array([[c, -s], [s, c]]) @ [20.0, 2.0]
    # A third of a pixel of 0.15 m: what is left of two resamplings after refinement.
    assert np.allclose((link.transform.x_m, link.transform.y_m), expected, atol=0.05)
    assert link.transform.yaw_rad == pytest.approx(0.05, abs=0.001)
    assert link.transform.scale == pytest.approx(1.0, abs=0.002)
    assert link.inliers >= MapperConfig().min_inliers


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("turn_deg", [95.0, 180.0, -85.0])
@pytest.mark.parametrize("told", [True, False])
def test_a_revisit_at_any_heading_is_registered(method: str, turn_deg: float, told: bool) -> None:
    """With the gimbal's heading, which is clockwise, and without."""
    turn = math.radians(turn_deg)
    earlier, later = shoot(0, 0.0, 0.0, 0.2)[0], shoot(1, 8.0, 5.0, 0.2 + turn)[0]
    link = registered(
        earlier, replace(later, attitude_xyzw=headed(LEVEL, -turn if told else 0.0)), config_of(method)
    )
    assert isinstance(link, Link)
    assert abs(math.remainder(link.transform.yaw_rad - turn, math.tau)) < 0.002


@pytest.mark.parametrize("method", METHODS)
def test_ground_that_does_not_overlap_and_a_jump_in_altitude_are_rejected(method: str) -> None:
    config = config_of(method)
    assert isinstance(registered(FIRST, shoot(9, 80.0, 60.0, 0.0)[0], config), Rejection)
    assert registered(FIRST, replace(SECOND, altitude_m=90.0), config) == Rejection("scale")


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("level", [0, 255])
def test_a_black_or_white_frame_links_to_nothing(method: str, level: int) -> None:
    blank = replace(FIRST, image_bgr=np.full_like(FIRST.image_bgr, level))
    for pair in ((FIRST, blank), (blank, FIRST), (blank, blank)):
        assert registered(*pair, config_of(method)) == Rejection("few_matches")


@pytest.mark.parametrize("method", METHODS)
def test_a_blurred_frame_is_registered_truly_or_not_at_all(method: str) -> None:
    for sigma in (2.0, 6.0, 20.0):
        blurred = replace(SECOND, image_bgr=cv2.GaussianBlur(SECOND.image_bgr, (0, 0), sigma))
        answer = registered(FIRST, blurred, config_of(method))
        sharp = registered(FIRST, SECOND, config_of(method))
        assert isinstance(sharp, Link)
        if isinstance(answer, Link):  # half the width of the blur
            shift = np.subtract(answer.transform[:2], sharp.transform[:2])
            assert np.hypot(*shift) < 0.5 * sigma * FIRST.altitude_m / CAMERA.fx


@pytest.mark.parametrize("method", METHODS)
def test_a_repeated_frame_has_not_moved(method: str) -> None:
    link = registered(FIRST, replace(FIRST, stamp_ns=1), config_of(method))
    assert isinstance(link, Link)
    assert np.allclose(link.transform, (0.0, 0.0, 0.0, 1.0), atol=1e-3)


def test_faint_ground_is_registered_by_faint_features() -> None:
    faint = [
        replace(frame, image_bgr=cv2.convertScaleAbs(frame.image_bgr, alpha=0.3, beta=60))
        for frame in (FIRST, SECOND)
    ]
    plain, link = registered(FIRST, SECOND, MapperConfig()), registered(*faint, MapperConfig())
    assert isinstance(plain, Link) and isinstance(link, Link)
    assert np.allclose(link.transform, plain.transform, atol=0.05)


def test_exposure_changes_do_not_move_the_camera() -> None:
    darker = replace(SECOND, image_bgr=cv2.convertScaleAbs(SECOND.image_bgr, alpha=0.6, beta=5))
    there, same = (registered(FIRST, frame, MapperConfig()) for frame in (darker, SECOND))
    assert isinstance(there, Link) and isinstance(same, Link)
    assert np.allclose(there.transform, same.transform, atol=0.02)


def test_a_turn_that_the_gimbal_denies_is_rejected_only_when_asked() -> None:
    strict = replace(MapperConfig(), max_yaw_deviation_deg=2.0)
    assert registered(FIRST, SECOND, MapperConfig()).__class__ is Link
    assert registered(FIRST, SECOND, strict) == Rejection("yaw")  # 0.05 rad, and the gimbal says 0
    told = replace(SECOND, attitude_xyzw=headed(SECOND.attitude_xyzw, -0.05))
    assert registered(FIRST, told, strict).__class__ is Link


LENSES = [
    ((-0.25, 0.08, 0.001, -0.002), "plumb_bob"),
    ((-0.25, 0.08, 0.001, -0.002, 0.01, 0.1, 0.02, 0.001), "rational_polynomial"),
    ((0.05, -0.02, 0.003, -0.001), "equidistant"),
]


def through_lens(frame: Frame, distortion: tuple[float, ...], model: str) -> Frame:
    """The frame as a lens with this distortion would have taken it; its own camera has none."""
    camera = replace(frame.camera, distortion=distortion, distortion_model=model)
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    pixels = np.stack([u, v], axis=-1).reshape(-1, 1, 2)
    undistort = cv2.fisheye.undistortPoints if model == "equidistant" else cv2.undistortPoints
    k = camera_matrix(camera)
    ideal = undistort(pixels, k, np.array(distortion), R=np.eye(3), P=k).reshape(
        camera.height, camera.width, 2
    )
    image = cv2.remap(frame.image_bgr, ideal.astype(np.float32), None, cv2.INTER_LINEAR)
    return replace(frame, image_bgr=image, camera=camera)


@pytest.mark.parametrize(("distortion", "model"), LENSES)
def test_distortion_is_taken_out_before_registration(distortion: tuple[float, ...], model: str) -> None:
    frames = [through_lens(frame, distortion, model) for frame in (FIRST, SECOND)]
    clean, bent = registered(FIRST, SECOND, MapperConfig()), registered(*frames, MapperConfig())
    assert isinstance(clean, Link) and isinstance(bent, Link)
    assert np.allclose(bent.transform, clean.transform, atol=0.05)
    ignored = [replace(frame, camera=replace(frame.camera, distortion=())) for frame in frames]
    wrong = registered(*ignored, MapperConfig())
    assert isinstance(wrong, Rejection) or not np.allclose(wrong.transform, clean.transform, atol=0.1)


def test_camera_info_may_change_in_flight() -> None:
    wide = CameraModel(480, 360, 300.0, 300.0, 239.5, 179.5)
    pixel_to_old = camera_matrix(CAMERA) @ np.linalg.inv(camera_matrix(wide))
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    image = cv2.warpPerspective(SECOND.image_bgr, pixel_to_old, (480, 360), flags=flags)
    link = registered(FIRST, replace(SECOND, image_bgr=image, camera=wide), MapperConfig())
    same = registered(FIRST, SECOND, MapperConfig())
    assert isinstance(link, Link) and isinstance(same, Link)
    assert np.allclose(link.transform, same.transform, atol=0.05)


def test_a_level_image_shows_the_ground_where_it_is() -> None:
    frame = shoot(0, 5.0, -3.0, 0.4, 60.0, tilt(0.2, -0.15))[0]
    level = level_image(frame, 240)
    uv = np.array([[120.0, 90.0], [60.0, 100.0]])
    metres = level.to_metres(uv)
    rays = np.column_stack([metres * [1.0, -1.0], np.full(2, 60.0)]) @ level_matrix(frame.attitude_xyzw)
    pixels = rays @ camera_matrix(CAMERA).T
    pixels = pixels[:, :2] / pixels[:, 2:]
    shrunk = cv2.resize(
        cv2.cvtColor(frame.image_bgr, cv2.COLOR_BGR2GRAY), (240, 180), interpolation=cv2.INTER_AREA
    )
    for (u, v), (a, b) in zip(uv.astype(int), (pixels + 0.5) / 2 - 0.5, strict=True):
        patch = cv2.getRectSubPix(shrunk, (1, 1), (float(a), float(b)))
        assert abs(int(level.grey[v, u]) - int(patch[0, 0])) <= 2
    assert level.sees(uv).all()
    assert not level.sees(np.array([[0.0, 0.0], [-5.0, 3.0], [1e4, 0.0]])).any()


def test_fit_measures_through_sloping_ground_and_its_covariance_holds() -> None:
    rng = np.random.default_rng(5)
    truth, slope, off = Similarity(6.0, 1.0, 0.2, 1.01), np.array([0.002, -0.001]), []
    for _ in range(200):
        source = rng.uniform(-30.0, 30.0, (80, 2))
        moved = np.array(truth[:2])
        target = truth.apply(source) + np.outer(source @ slope, moved) + rng.normal(0.0, 0.05, (80, 2))
        found, covariance = fit_similarity(source, target, moved, 0.002)
        error = np.subtract(found, truth) / [1.0, 1.0, 1.0, truth.scale]
        off.append(float(error @ np.linalg.solve(covariance, error)))
    # Four degrees of freedom: the mean of 200 is 4 within 0.2 for a covariance that is right; the slope's
    # prior, which is centred on level ground, shifts it a little.
    assert 3.0 < np.mean(off) < 5.0


def test_turning_back_undoes_a_quarter_turn() -> None:
    for shape in ((30, 50), (50, 30), (31, 40)):
        image = np.random.default_rng(1).integers(0, 256, shape, dtype=np.uint8)
        for turn in range(4):
            turned, offset = turn_image(image, turn)
            assert turned.shape == shape
            uv = np.array([[10.0, 12.0], [20.0, 14.0], [shape[1] // 2, shape[0] // 2]])
            back = turn_back(uv - offset, turn, shape).astype(int)
            assert (image[back[:, 1], back[:, 0]] == turned[uv[:, 1].astype(int), uv[:, 0].astype(int)]).all()


def test_fitting_and_unfitting_are_inverse() -> None:
    fitted, zoom = fit_into(np.zeros((300, 800), dtype=np.uint8), (640, 640))
    assert fitted.shape == (640, 640) and zoom == pytest.approx(0.8)
    assert unfit(np.array([[-0.5, -0.5], [639.5, 239.5]]), zoom) == pytest.approx(
        np.array([[-0.5, -0.5], [799.5, 299.5]])
    )


def test_sift_matches_are_one_to_one() -> None:
    sift = Sift(500, 640, 0.8)
    features = sift.prepare(FIRST.image_bgr[:, :, 0])
    matches = sift.match(features, features)
    assert len(matches.later_uv) > 100
    assert (matches.earlier_uv == matches.later_uv).all()
    # Keypoints of several orientations share a place, but no descriptor is matched twice.
    assert len(matches.later_uv) <= len(features.uv)


def test_xfeat_decoding_of_a_drawn_heat_map() -> None:
    logits = np.zeros((65, 4, 5), dtype=np.float32)
    logits[64] = 10.0  # nothing anywhere, but
    logits[3 * 8 + 6, 2, 1] = 20.0  # row 3, column 6 of the cell in row 2, column 1
    uv, scores = keypoints(logits)
    assert uv.tolist() == [[14.0, 19.0]] and scores[0] > 0.99
    ramp = np.tile(np.arange(5, dtype=np.float32), (1, 4, 1))
    assert sample(ramp, np.array([[3.5, 3.5], [7.5, 3.5], [500.0, 3.5]]))[:, 0] == pytest.approx(
        [0.0, 0.5, 4.0]
    )


def loftr_file(path: Path, grid: np.ndarray, confidences: np.ndarray) -> Path:
    """A network of LoFTR's contract that answers with these pixels in both images, whatever they show."""
    inputs = [helper.make_tensor_value_info(n, TensorProto.FLOAT, [1, 1, 480, 640]) for n in ("a", "b")]
    values = {"mkpts0": grid, "mkpts1": grid, "mconf": confidences}
    nodes = [
        helper.make_node("Constant", [], [n], value=numpy_helper.from_array(v.astype(np.float32)))
        for n, v in values.items()
    ]
    outputs = [helper.make_tensor_value_info(n, TensorProto.FLOAT, v.shape) for n, v in values.items()]
    graph = helper.make_graph(nodes, "loftr", inputs, outputs)
    onnx.save(helper.make_model(graph, ir_version=9, opset_imports=[helper.make_opsetid("", 17)]), str(path))
    return path


GRID = np.stack(np.meshgrid(np.arange(60, 580, 40.0), np.arange(60, 420, 40.0)), axis=-1).reshape(-1, 2)


def test_full_loftr_keeps_its_contract_and_is_refined(tmp_path: Path) -> None:
    """Its answer "nothing moved" is 1 m off, some 5 px; the refinement finds the rest."""
    path = loftr_file(tmp_path / "loftr.onnx", GRID, np.ones(len(GRID)))
    config = replace(MapperConfig(), registration="loftr", registration_model=str(path))
    link = registered(shoot(0, 0.0, 0.0, 0.0)[0], shoot(1, 0.8, -0.6, 0.0)[0], config)
    assert isinstance(link, Link) and link.inliers == len(GRID)
    assert np.allclose(link.transform[:2], (0.8, -0.6), atol=0.05)
    unsure = loftr_file(tmp_path / "unsure.onnx", GRID, np.full(len(GRID), 0.1))
    assert registered(FIRST, SECOND, replace(config, registration_model=str(unsure))) == Rejection(
        "few_matches"
    )


def test_a_network_of_another_contract_is_refused_in_one_line(tmp_path: Path) -> None:
    broken = loftr_file(tmp_path / "broken.onnx", GRID, np.ones(3))
    config = replace(MapperConfig(), registration="loftr", registration_model=str(broken))
    with pytest.raises(BuildlocError, match=r"are not \(N, 2\), \(N, 2\), \(N,\)") as caught:
        registered(FIRST, SECOND, config)
    assert "\n" not in str(caught.value)
    with pytest.raises(BuildlocError, match="has 2 inputs and 3 outputs, xfeat 1 and 3"):
        Registration(replace(config, registration="xfeat"))


@pytest.mark.parametrize(
    ("registration", "model", "message"),
    [
        ("orb", "", "parameter registration = 'orb' is unknown; choose sift, xfeat, coarse_loftr, loftr"),
        ("xfeat", "", "registration xfeat needs weights; name its ONNX file: registration_model"),
        ("coarse_loftr", "/nowhere.onnx", "/nowhere.onnx: no such ONNX file"),
        ("loftr", __file__, "is not a loadable ONNX network"),
    ],
)
def test_a_method_that_cannot_be_had_refuses_to_start(registration: str, model: str, message: str) -> None:
    with pytest.raises(BuildlocError, match=message) as caught:
        Mapper(replace(MapperConfig(), registration=registration, registration_model=model))
    assert "\n" not in str(caught.value)
