"""Every bad input on the command line: one line on stderr that says what is wrong, exit status 2."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import pytest
from buildloc.cli import main
from reference_files import (
    BAD_DATABASES,
    BAD_FOOTPRINTS,
    bad_database,
    build_database,
    houses,
    write_geojson,
)
from tiny_bags import WIDTH, truncate, write_bag

SQUARE_M: dict[str, Any] = {"type": "Polygon", "coordinates": [[[0, 0], [9, 0], [9, 9], [0, 9], [0, 0]]]}
NOT_OPENED = {  # what is wrong before any message is read
    "missing": "no such bag",
    "truncated": "truncated or damaged",
    "of no bytes": "truncated or damaged",
    "empty": "holds no messages",
    "without camera/image": "no messages on camera/image or camera/image/compressed",
    "without camera/camera_info": "no messages on camera/camera_info",
    "without altitude": "no messages on altitude",
    "without gimbal/attitude": "no messages on gimbal/attitude",
}
UNUSABLE: dict[str, tuple[dict[str, Any], str]] = {  # every image is, and why
    "encoding": ({"encoding": "bayer_rggb8"}, "'bayer_rggb8' is not supported"),
    "size": ({"info_width": WIDTH + 1}, "camera_info says 97x64"),
    "NaN altitude": ({"altitude_m": math.nan}, "altitude nan m is not a positive number"),
    "zero altitude": ({"altitude_m": 0.0}, "altitude 0.0 m is not a positive number"),
    "negative altitude": ({"altitude_m": -10.0}, "altitude -10.0 m is not a positive number"),
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Good inputs: footprints, database, bag, map."""
    made = tmp_path_factory.mktemp("good")
    build_database(made / "good.bldb", houses(made / "houses.geojson"))
    write_bag(made / "bag")
    write_geojson(made / "map.geojson", [SQUARE_M])
    return made


def bad_bag(kind: str, path: Path) -> Path:
    if kind == "missing":
        return path
    if kind == "truncated":
        return truncate(write_bag(path), 0.5)
    if kind == "of no bytes":
        return truncate(write_bag(path), 0.0)
    if kind == "empty":
        return write_bag(path, frames=0)
    if kind == "without camera/image":
        return write_bag(path, without=("/camera/image/compressed",))
    return write_bag(path, without=("/" + kind.removeprefix("without "),))


def refused(
    arguments: list[str], text: str, capfd: pytest.CaptureFixture[str], recwarn: pytest.WarningsRecorder
) -> None:
    """Run a command that must end with status 2 and one line on stderr that contains ``text``."""
    capfd.readouterr()
    recwarn.clear()
    assert main(arguments) == 2
    said = capfd.readouterr().err
    assert said.startswith("error: ") and said.endswith("\n") and said.count("\n") == 1, said
    assert text in said, said
    # pytest takes warnings away from stderr, where a user would see them.
    shown = [w for w in recwarn if not issubclass(w.category, DeprecationWarning)]
    assert not shown, shown[0].message


def on_a_bag(command: str, bag: Path, folder: Path, out: Path) -> list[str]:
    """The arguments of a command that reads a bag, all others being good."""
    if command in ("run", "replay"):
        return [command, str(bag), "--database", str(folder / "good.bldb")]
    return [command, str(bag), "--out", str(out / f"{command}.geojson")]


@pytest.mark.parametrize("kind", NOT_OPENED)
@pytest.mark.parametrize("command", ["run", "segment", "map", "replay"])
def test_a_bag_that_cannot_be_read(
    command: str, kind: str, folder: Path, tmp_path: Path,
    capfd: pytest.CaptureFixture[str], recwarn: pytest.WarningsRecorder,
) -> None:  # fmt: skip
    if command == "replay":
        pytest.importorskip("rclpy", reason="ROS is not installed")
    bag = bad_bag(kind, tmp_path / "bag")
    refused(on_a_bag(command, bag, folder, tmp_path), NOT_OPENED[kind], capfd, recwarn)


@pytest.mark.parametrize("kind", UNUSABLE)
@pytest.mark.parametrize("command", ["run", "segment", "map"])
def test_a_bag_in_which_no_image_can_be_used(
    command: str, kind: str, folder: Path, tmp_path: Path,
    capfd: pytest.CaptureFixture[str], recwarn: pytest.WarningsRecorder,
) -> None:  # fmt: skip
    options, text = UNUSABLE[kind]
    bag = write_bag(tmp_path / "bag", **options)
    refused(on_a_bag(command, bag, folder, tmp_path), text, capfd, recwarn)


@pytest.mark.parametrize("kind", BAD_DATABASES)
@pytest.mark.parametrize("command", ["run", "replay", "locate", "refdb info"])
def test_a_database_that_cannot_be_used(
    command: str, kind: str, folder: Path, tmp_path: Path,
    capfd: pytest.CaptureFixture[str], recwarn: pytest.WarningsRecorder,
) -> None:  # fmt: skip
    if command == "replay":
        pytest.importorskip("rclpy", reason="ROS is not installed")
    database = str(bad_database(kind, tmp_path / "bad.bldb", folder / "houses.geojson"))
    arguments = {
        "run": ["run", str(folder / "bag"), "--database", database],
        "replay": ["replay", str(folder / "bag"), "--database", database],
        "locate": ["locate", database, str(folder / "map.geojson")],
        "refdb info": ["refdb", "info", database],
    }
    refused(arguments[command], BAD_DATABASES[kind], capfd, recwarn)


@pytest.mark.parametrize("kind", BAD_FOOTPRINTS)
def test_footprints_of_which_none_is_a_building(
    kind: str, tmp_path: Path, capfd: pytest.CaptureFixture[str], recwarn: pytest.WarningsRecorder
) -> None:
    geometries, text = BAD_FOOTPRINTS[kind]
    source, out = write_geojson(tmp_path / "footprints.geojson", geometries), tmp_path / "out.bldb"
    refused(["refdb", "build", str(source), "--out", str(out)], text, capfd, recwarn)
    assert not out.exists()


def test_a_parameter_out_of_range_is_named_with_its_range(
    folder: Path, capfd: pytest.CaptureFixture[str], recwarn: pytest.WarningsRecorder
) -> None:
    arguments = ["run", str(folder / "bag"), "--database", str(folder / "good.bldb")]
    text = "parameter features = 7 is out of range [50, 20000]"
    refused([*arguments, "--set", "mapper_node.features=7"], text, capfd, recwarn)


@pytest.mark.parametrize(
    ("options", "text"),
    [
        (["--registration", "orb"], "parameter registration = 'orb' is unknown; choose sift, xfeat"),
        (["--registration", "xfeat"], "registration xfeat needs weights"),
        (["--registration", "xfeat", "--registration-model", "none.onnx"], "none.onnx: no such ONNX file"),
    ],
)
def test_a_registration_that_cannot_be_had(
    options: list[str], text: str, folder: Path, tmp_path: Path,
    capfd: pytest.CaptureFixture[str], recwarn: pytest.WarningsRecorder,
) -> None:  # fmt: skip
    out = str(tmp_path / "map.geojson")
    refused(["map", str(folder / "bag"), "--out", out, *options], text, capfd, recwarn)


def test_some_unusable_images_are_one_warning_and_no_error(
    folder: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    bag, out = write_bag(tmp_path / "bag", frames=4, bad_altitude_at=(2, 3)), tmp_path / "fixes.jsonl"
    assert main(["run", str(bag), "--database", str(folder / "good.bldb"), "--out", str(out)]) == 0
    said = capfd.readouterr()
    assert said.err.startswith("warning: 2 of 4 images cannot be used") and said.err.count("\n") == 1
    assert said.out.count("no fix: altitude nan m is not a positive number") == 2
    assert out.read_text().count("altitude nan m") == 2
