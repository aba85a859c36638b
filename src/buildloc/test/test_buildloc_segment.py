"""`buildloc segment`: what it writes, and every kind of image file that it may be given."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import onnx
import pytest
from buildloc.cli import main
from buildloc.images import ImageError, find_images, read_image
from onnx import TensorProto, helper, numpy_helper
from shapely.geometry import shape
from tiny_bags import write_bag

GSD_M = 0.2
ROWS, COLUMNS = 60, 100
HOUSE = (20, 10, 60, 40)  # left, top, right, bottom; pixels
SETTINGS = [
    "--set", "segmenter_node.input_multiple=8", "--set", "segmenter_node.std=[255.0, 255.0, 255.0]",
]  # fmt: skip


def scene() -> np.ndarray:
    """A white house on black ground, BGR."""
    image = np.zeros((ROWS, COLUMNS, 3), dtype=np.uint8)
    left, top, right, bottom = HOUSE
    image[top:bottom, left:right] = 255
    return image


def house_mask() -> np.ndarray:
    return scene()[:, :, 0]


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> str:
    """White is building: the sum of the three channels, less one and a half."""
    path = tmp_path_factory.mktemp("network") / "white.onnx"
    kernel = numpy_helper.from_array(np.full((1, 3, 1, 1), 10.0, dtype=np.float32), "kernel")
    bias = numpy_helper.from_array(np.float32([-15.0]), "bias")
    graph = helper.make_graph(
        [helper.make_node("Conv", ["image", "kernel", "bias"], ["scores"])],
        "white",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, ["n", 3, "h", "w"])],
        [helper.make_tensor_value_info("scores", TensorProto.FLOAT, None)],
        [kernel, bias],
    )
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8), str(path))
    return str(path)


def segment(network: str, out: Path, *arguments: object, gsd_m: float | None = GSD_M) -> int:
    gsd = [] if gsd_m is None else ["--gsd", str(gsd_m)]
    chosen = ["--set", f"segmenter_node.model={network}", *SETTINGS]
    return main(["segment", *(str(a) for a in arguments), "-o", str(out), *gsd, *chosen])


def write(path: Path, image: np.ndarray) -> Path:
    assert cv2.imwrite(str(path), image)
    return path


def exif_jpeg(path: Path, image: np.ndarray, orientation: int) -> Path:
    """A JPEG whose EXIF says how to turn it."""
    data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 100])[1].tobytes()
    tiff = b"MM\x00*\x00\x00\x00\x08\x00\x01\x01\x12\x00\x03\x00\x00\x00\x01" + bytes([0, orientation, 0, 0])
    payload = b"Exif\x00\x00" + tiff + b"\x00\x00\x00\x00"
    path.write_bytes(data[:2] + b"\xff\xe1" + (len(payload) + 2).to_bytes(2, "big") + payload + data[2:])
    return path


def test_mask_outlines_and_overlay(network: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    write(tmp_path / "a.png", scene())
    out = tmp_path / "out"
    assert segment(network, out, tmp_path / "a.png", "--overlay") == 0
    assert sorted(file.name for file in out.iterdir()) == ["a.geojson", "a_mask.png", "a_overlay.png"]
    assert (cv2.imread(str(out / "a_mask.png"), cv2.IMREAD_UNCHANGED) == house_mask()).all()
    (feature,) = json.loads((out / "a.geojson").read_text())["features"]
    left, top, right, bottom = HOUSE
    outline = shape(feature["geometry"])
    assert len(outline.exterior.coords) == 5 and outline.bounds == pytest.approx(HOUSE, abs=0.3)
    area_m2 = (right - left) * (bottom - top) * GSD_M**2
    assert feature["properties"]["area_m2"] == pytest.approx(area_m2, rel=0.02)
    assert feature["properties"]["centroid"] == pytest.approx([40.0, 25.0], abs=0.1)
    assert feature["properties"]["score"] == pytest.approx(1.0, abs=0.01)
    overlay = cv2.imread(str(out / "a_overlay.png"))
    assert overlay.shape == scene().shape and tuple(overlay[top, 40]) == (0, 0, 255)
    assert (overlay[25, 40] == 255).all() and (overlay[50, 80] == 0).all()
    assert capsys.readouterr().out == f"{out}: 1 buildings in 1 of 1 images\n"


def test_folders_and_files_together(network: str, tmp_path: Path) -> None:
    folder = tmp_path / "flight"
    folder.mkdir()
    for name in ("b.JPG", "a.tif"):
        write(folder / name, scene())
    (folder / "notes.txt").write_text("no image")
    write(tmp_path / "c.png", scene())
    assert [path.name for path in find_images([folder, tmp_path / "c.png"])] == ["a.tif", "b.JPG", "c.png"]
    out = tmp_path / "out"
    assert segment(network, out, folder, tmp_path / "c.png") == 0
    assert sorted(file.name for file in out.glob("*_mask.png")) == ["a_mask.png", "b_mask.png", "c_mask.png"]


def test_a_bag_gives_its_keyframes(network: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    assert segment(network, out, write_bag(tmp_path / "bag", frames=3), "--overlay", gsd_m=None) == 0
    masks = list(out.glob("*_mask.png"))
    assert masks and len(list(out.glob("*.geojson"))) == len(list(out.glob("*_overlay.png"))) == len(masks)


KINDS = {
    "grey": lambda image: image[:, :, 0],
    "RGBA": lambda image: cv2.cvtColor(image, cv2.COLOR_BGR2BGRA),
    "16-bit": lambda image: image.astype(np.uint16) * 257,
    "12 of 16 bits": lambda image: image.astype(np.uint16) * 16,
    "16-bit grey": lambda image: image[:, :, 0].astype(np.uint16) * 257,
}


@pytest.mark.parametrize("suffix", ["png", "tif"])
@pytest.mark.parametrize("kind", KINDS)
def test_images_of_other_kinds_give_the_same_mask(
    network: str, kind: str, suffix: str, tmp_path: Path
) -> None:
    path = write(tmp_path / f"a.{suffix}", KINDS[kind](scene()))
    image = read_image(path)
    assert image.dtype == np.uint8 and np.abs(image.astype(int) - scene()).max() <= 1
    assert segment(network, tmp_path / "out", path) == 0
    assert (cv2.imread(str(tmp_path / "out" / "a_mask.png"), cv2.IMREAD_UNCHANGED) == house_mask()).all()


@pytest.mark.parametrize(("orientation", "turns"), [(1, 0), (3, 2), (6, 3), (8, 1)])
def test_masks_are_upright_as_the_exif_orientation_says(
    network: str, orientation: int, turns: int, tmp_path: Path
) -> None:
    path = exif_jpeg(tmp_path / "a.jpg", scene(), orientation)
    assert segment(network, tmp_path / "out", path) == 0
    mask = cv2.imread(str(tmp_path / "out" / "a_mask.png"), cv2.IMREAD_UNCHANGED)
    assert ((mask > 0) == (np.rot90(house_mask(), turns) > 0)).mean() > 0.99


def damaged(kind: str, folder: Path) -> Path:
    if kind == "empty":
        path = folder / "bad.jpg"
        path.touch()
        return path
    if kind == "text":
        path = folder / "bad.jpg"
        path.write_text("no image")
        return path
    if kind == "float":
        return write(folder / "bad.tif", scene().astype(np.float32))
    suffix, _, what = kind.partition(" ")
    path = write(folder / f"bad.{suffix}", np.random.default_rng(0).integers(0, 256, (200, 300, 3), np.uint8))
    data = bytearray(path.read_bytes())
    if what == "cut":
        del data[len(data) // 2 :]
    else:
        data[len(data) // 2 : len(data) // 2 + 50] = bytes(50)
    path.write_bytes(data)
    return path


DAMAGED = {
    "empty": "is empty; copy it again",
    "text": "is damaged or no image (JPEG, PNG, TIFF)",
    "float": "pixels are float32; export it with 8 or 16 bits",
    "jpg cut": "is damaged or no image",
    "png cut": "is damaged or no image",
    "tif cut": "is damaged or no image",
    "png overwritten": "is damaged or no image",
}


@pytest.mark.parametrize("kind", DAMAGED)
def test_a_damaged_file_is_one_line_and_the_others_are_done(
    network: str, kind: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    first, last = write(tmp_path / "a.png", scene()), write(tmp_path / "z.png", scene())
    bad, out = damaged(kind, tmp_path), tmp_path / "out"
    assert segment(network, out, first, bad, last) == 2
    said = capfd.readouterr()
    assert said.err.count("\n") == 1 and said.err.startswith(f"error: {bad}: {DAMAGED[kind]}"), said.err
    assert said.out == f"{out}: 2 buildings in 2 of 3 images\n"
    assert sorted(file.name for file in out.glob("*_mask.png")) == ["a_mask.png", "z_mask.png"]


def test_an_image_of_more_pixels_than_the_decoder_takes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def decode(*_: object) -> None:
        raise cv2.error("pixels <= CV_IO_MAX_IMAGE_PIXELS")

    monkeypatch.setattr(cv2, "imdecode", decode)
    with pytest.raises(ImageError, match="too large to be decoded here; cut it into parts"):
        read_image(write(tmp_path / "a.png", scene()))


@pytest.mark.parametrize(
    ("names", "gsd_m", "text"),
    [
        (["a.png"], None, "images do not tell metres per pixel; give --gsd M"),
        (["absent.png"], GSD_M, "absent.png: no such bag, image or folder"),
        (["empty"], GSD_M, "empty: is a folder without metadata.yaml and without images"),
        (["a.png", "copy/a.png"], GSD_M, "would have the same results"),
        (["bag"], GSD_M, "--gsd is for images"),
        (["bag", "a.png"], None, "give one bag, or images"),
    ],
)
def test_what_cannot_be_done_is_one_line_before_anything_is_written(
    network: str, names: list[str], gsd_m: float | None, text: str, tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    (tmp_path / "empty").mkdir()
    (tmp_path / "copy").mkdir()
    write(tmp_path / "a.png", scene())
    write(tmp_path / "copy" / "a.png", scene())
    write_bag(tmp_path / "bag", frames=1)
    assert segment(network, tmp_path / "out", *(tmp_path / name for name in names), gsd_m=gsd_m) == 2
    said = capfd.readouterr().err
    assert said.startswith("error: ") and said.count("\n") == 1 and text in said
    assert not (tmp_path / "out").exists()


def test_results_of_before_are_not_overwritten(network: str, tmp_path: Path) -> None:
    path, out = write(tmp_path / "a.png", scene()), tmp_path / "out"
    assert segment(network, out, path) == 0
    before = (out / "a_mask.png").read_bytes()
    assert segment(network, out, path) == 2
    assert (out / "a_mask.png").read_bytes() == before


@pytest.mark.parametrize("gsd", ["0", "-1", "nan", "wide"])
def test_a_gsd_that_is_no_length(gsd: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stopped:
        main(["segment", "a.png", "-o", "out", "--gsd", gsd])
    assert stopped.value.code == 2 and "is not a length in metres above 0" in capsys.readouterr().err


@pytest.mark.parametrize("gsd_m", [0.01, 5.0])
def test_a_gsd_far_from_the_training_is_warned_of_and_runs(
    network: str, gsd_m: float, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path / "a.png", scene())
    assert segment(network, tmp_path / "out", path, gsd_m=gsd_m) == 0
    said = capfd.readouterr().err
    assert said.startswith("warning: ") and said.count("\n") == 1
    assert f"{gsd_m:g} m per pixel, outside of the 0.1 to 0.5 m" in said
    assert cv2.imread(str(tmp_path / "out" / "a_mask.png")).shape == scene().shape


def test_a_file_that_is_no_segmentation_network(
    network: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path / "a.png", scene())
    model = onnx.load(network)
    model.graph.node[0].CopyFrom(helper.make_node("Flatten", ["image"], ["scores"]))
    onnx.save(model, str(tmp_path / "flat.onnx"))
    assert segment(str(tmp_path / "flat.onnx"), tmp_path / "out", path) == 2
    said = capfd.readouterr().err
    assert said.count("\n") == 1
    assert "flat.onnx: is not a segmentation network" in said and "expected" in said and "found" in said


def test_an_image_larger_than_a_block_is_done_in_parts(network: str, tmp_path: Path) -> None:
    # 0.8 m per pixel for a network of 0.2: 4 network pixels to each, 2800 x 2000 in all.
    image = np.zeros((500, 700, 3), dtype=np.uint8)
    corners = [(x, y) for x in range(20, 680, 60) for y in range(20, 480, 60)]
    for x, y in corners:
        image[y : y + 15, x : x + 20] = 255
    assert segment(network, tmp_path / "out", write(tmp_path / "a.png", image), gsd_m=0.8) == 0
    mask = cv2.imread(str(tmp_path / "out" / "a_mask.png"), cv2.IMREAD_UNCHANGED)
    assert ((mask > 0) == (image[:, :, 0] > 0)).mean() > 0.995
    assert cv2.connectedComponents(mask)[0] - 1 == len(corners)
    features = json.loads((tmp_path / "out" / "a.geojson").read_text())["features"]
    found = sorted(feature["properties"]["centroid"] for feature in features)
    assert np.array(found) == pytest.approx(
        np.array(sorted([x + 10.0, y + 7.5] for x, y in corners)), abs=0.3
    )
