"""The command line: every stage alone, offline, through files."""

from __future__ import annotations

import argparse
import importlib.metadata
import json
import math
import os
import shlex
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from buildloc_msgs_py.errors import BuildlocError

if TYPE_CHECKING:
    from buildloc_msgs_py.pairing import FrameFault
    from buildloc_msgs_py.types import Frame

    from buildloc.settings import Settings

Run = Callable[[argparse.Namespace], int]
EXTENSIONS = "buildloc.commands"
TOLD_NS = 1_000_000_000


def _location(text: str) -> tuple[float, float]:
    try:
        latitude, longitude = (float(v) for v in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not LATITUDE,LONGITUDE") from None
    if not (abs(latitude) <= 90.0 and abs(longitude) <= 180.0):
        raise argparse.ArgumentTypeError(f"{text!r} is not LATITUDE,LONGITUDE in degrees")
    return latitude, longitude


def _box(text: str) -> tuple[float, ...]:
    try:
        west, south, east, north = (float(v) for v in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is not WEST,SOUTH,EAST,NORTH") from None
    return west, south, east, north


def _point(text: str) -> tuple[float, float]:
    try:
        x, y = (float(v) for v in text.split(","))
    except ValueError:
        x = y = math.nan
    if not (math.isfinite(x) and math.isfinite(y)):
        raise argparse.ArgumentTypeError(f"{text!r} is not X,Y in metres of the map")
    return x, y


def _count(text: str) -> int:
    if not text.isdecimal():
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number, 0 or more")
    return int(text)


def _metres(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a length in metres above 0")
    return value


def _settings_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--config", type=Path, help="YAML of ROS parameters")
    parser.add_argument(
        "--set", action="append", default=[], metavar="NODE.PARAMETER=VALUE", dest="overrides",
        help="override one parameter, e.g. segmenter_node.model=net.onnx; repeatable",
    )  # fmt: skip


def _settings(args: argparse.Namespace) -> Settings:
    """The settings of a command with --config, --preset and --set, the later over the earlier."""
    from buildloc.settings import MATCHER, load

    preset = [] if args.preset is None else [f"{MATCHER}.preset={args.preset}"]
    return load(args.config, [*preset, *args.overrides])


def _registration(args: argparse.Namespace) -> list[str]:
    """--registration and --registration-model as overrides of the mapper's parameters."""
    from buildloc.settings import MAPPER

    given = {"registration": args.registration, "registration_model": args.registration_model}
    return [f"{MAPPER}.{name}={json.dumps(str(value))}" for name, value in given.items() if value is not None]


def _progress(text: str) -> None:
    if sys.stderr.isatty():
        print(f"\r\x1b[K{text}", end="", file=sys.stderr, flush=True)


def _progress_end() -> None:
    _progress("")


def _frames(bag: Path) -> Iterator[Frame | FrameFault]:
    """The images of a bag in order. Those that cannot be used are one warning; an error when all are."""
    from buildloc_msgs_py.pairing import FrameFault

    from buildloc.bag import read_frames

    images, faults = 0, list[FrameFault]()
    for frame in read_frames(bag):
        images += 1
        if isinstance(frame, FrameFault):
            faults.append(frame)
        yield frame
    _progress_end()
    if faults and len(faults) == images:
        raise BuildlocError(f"{bag}: none of {images} images can be used: {faults[0].reason}")
    if faults:
        first = f"the first: {faults[0].reason}"
        print(f"warning: {len(faults)} of {images} images cannot be used; {first}", file=sys.stderr)


def _refdb_fetch(args: argparse.Namespace) -> int:
    from buildloc_matcher.reference.download import HttpConfig
    from buildloc_matcher.reference.fetch import (
        MICROSOFT_INDEX,
        OvertureMaps,
        fetch_microsoft,
        fetch_overture,
    )
    from buildloc_matcher.reference.region import Circle

    latitude_deg, longitude_deg = args.center
    area = Circle(latitude_deg, longitude_deg, args.radius_km)
    if args.source == "overture":
        if args.index_url is not None:
            raise BuildlocError("--index-url is for --source microsoft; leave it out")
        files = fetch_overture(area, args.out, OvertureMaps(), _progress)
    else:
        files = fetch_microsoft(area, args.out, args.index_url or MICROSOFT_INDEX, HttpConfig(), _progress)
    _progress_end()
    for file in files:
        if file.doubt is not None:
            print(f"warning: {file.path}: {file.doubt}", file=sys.stderr)
        print(f"{file.path}  {file.size / 1e6:.1f} MB  {'fetched' if file.fresh else 'unchanged'}")
    for licence in sorted({file.licence for file in files}):
        print(f"licence: {licence}")
    build = [
        "buildloc", "refdb", "build", *(str(file.path) for file in files),
        f"--center={latitude_deg},{longitude_deg}", "--radius-km", f"{args.radius_km:g}",
        "--out", str(args.out / "reference.bldb"),
    ]  # fmt: skip
    print(f"next: {shlex.join(build)}")
    return 0


def _refdb_build(args: argparse.Namespace) -> int:
    from buildloc_matcher.reference.build import build
    from buildloc_matcher.reference.region import Box, Circle, Region

    from buildloc.settings import REFERENCE_DB, load, matcher_config_of

    if (args.center is None) != (args.radius_km is None) or (args.center and args.bbox):
        raise BuildlocError("give --center and --radius-km together, or --bbox, or neither for all")
    region: Region | None = Box(*args.bbox) if args.bbox else None
    if args.center:
        latitude, longitude = args.center
        region = Circle(latitude, longitude, args.radius_km)
    config = matcher_config_of(load(args.config, args.overrides), REFERENCE_DB)
    report = build(
        args.sources, args.out, config, region, tile_km=args.tile_km, licence=args.licence,
        scheduler=args.scheduler, progress=_progress,
    )  # fmt: skip
    _progress_end()
    print(f"{report.table()}\n{args.out}: {report.counts['used']} buildings, EPSG:{report.epsg}")
    return 0


def _refdb_info(args: argparse.Namespace) -> int:
    from buildloc_matcher.reference.database import describe_database

    from buildloc.settings import REFERENCE_DB, load, matcher_config_of

    config = matcher_config_of(load(args.config, args.overrides), REFERENCE_DB)
    for name, value in describe_database(args.database, config):
        print(f"{name:>20}  {value}")
    return 0


def _empty_folder(path: Path) -> Path:
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise BuildlocError(f"{path}: exists and is not an empty folder; choose another --out")
    path.mkdir(parents=True, exist_ok=True)
    return path


def _segment(args: argparse.Namespace) -> int:
    from buildloc.images import is_bag

    if not any(is_bag(path) for path in args.inputs):
        return _segment_images(args)
    if len(args.inputs) > 1:
        raise BuildlocError("give one bag, or images and folders of images")
    if args.gsd is not None:
        raise BuildlocError("--gsd is for images; a bag has altitude and camera_info")
    return _segment_bag(args)


def _segment_images(args: argparse.Namespace) -> int:
    from buildloc_segmenter.config import SegmenterConfig
    from buildloc_segmenter.network import Network

    from buildloc.images import ImageError, find_images, read_image, write_results
    from buildloc.settings import SEGMENTER, config_of, load

    paths = find_images(args.inputs)
    if args.gsd is None:
        raise BuildlocError(
            "images do not tell metres per pixel; give --gsd M (height above ground / focal length in px)"
        )
    network = Network(config_of(load(args.config, args.overrides), SEGMENTER, SegmenterConfig))
    doubt = network.doubt(args.gsd)
    if doubt is not None:
        print(f"warning: {doubt}", file=sys.stderr)
    out, buildings, failed = _empty_folder(args.out), 0, 0
    for number, path in enumerate(paths, start=1):
        try:
            image = read_image(path)
        except ImageError as error:
            failed += 1
            _progress_end()
            print(f"error: {error}", file=sys.stderr)
            continue
        found = network.segment_buildings(image, args.gsd)
        write_results(found, image, out, path.stem, args.overlay)
        buildings += len(found.buildings)
        _progress(f"{number} of {len(paths)} images, {buildings} buildings")
    _progress_end()
    print(f"{out}: {buildings} buildings in {len(paths) - failed} of {len(paths)} images")
    return 2 if failed else 0


def _segment_bag(args: argparse.Namespace) -> int:
    from buildloc_msgs_py.pairing import FrameFault
    from buildloc_segmenter.config import SegmenterConfig
    from buildloc_segmenter.segmenter import Segmenter

    from buildloc.images import write_results
    from buildloc.settings import SEGMENTER, config_of, load

    segmenter = Segmenter(config_of(load(args.config, args.overrides), SEGMENTER, SegmenterConfig))
    frames = faults = keyframes = 0
    for frame in _frames(args.inputs[0]):
        if isinstance(frame, FrameFault):
            faults += 1
            continue
        if frames == 0:
            _empty_folder(args.out)
        frames += 1
        if segmenter.select(frame):
            keyframes += 1
            found = segmenter.segment_buildings(frame)
            write_results(found, frame.image_bgr, args.out, str(frame.stamp_ns), args.overlay)
            _progress(f"{frames} frames, {keyframes} keyframes")
    print(f"{args.out}: {keyframes} masks of {frames} frames, {faults} frames unusable")
    return 0


def _map(args: argparse.Namespace) -> int:
    from buildloc_mapper.config import MapperConfig
    from buildloc_mapper.mapper import Mapper
    from buildloc_msgs_py.pairing import FrameFault
    from buildloc_segmenter.config import SegmenterConfig
    from buildloc_segmenter.segmenter import Segmenter

    from buildloc.mapfile import write_map, write_tum
    from buildloc.settings import MAPPER, SEGMENTER, config_of, load

    settings = load(args.config, [*_registration(args), *args.overrides])
    segmenter = Segmenter(config_of(settings, SEGMENTER, SegmenterConfig))
    mapper = Mapper(config_of(settings, MAPPER, MapperConfig))
    update, picture, refused = None, None, list[str]()
    for path in (args.out, args.trajectory, args.plot):
        if isinstance(path, Path):  # before the work, not after it
            path.parent.mkdir(parents=True, exist_ok=True)
    if args.plot is not None:
        from buildloc.map_picture import MapPicture  # matplotlib is loaded for pictures alone

        picture = MapPicture()
    for frame in _frames(args.bag):
        if isinstance(frame, FrameFault) or (mask := segmenter.process(frame)) is None:
            continue
        try:
            update = mapper.add(frame, mask) or update
            if picture is not None:
                picture.add(frame)
        except BuildlocError as error:
            refused.append(str(error))
        if update is not None:
            _progress(f"{len(update.keyframes)} keyframes, {len(update.local_map)} buildings")
    update = mapper.finish()
    if refused:
        print(f"warning: {len(refused)} keyframes were refused; the first: {refused[0]}", file=sys.stderr)
    if update is None:
        raise BuildlocError(f"{args.bag}: gave no map; no keyframe could be added")
    write_map(update.outlines, update.local_map, args.out)
    print(f"{args.out}: {len(update.local_map)} buildings from {len(update.keyframes)} keyframes")
    if args.trajectory is not None:
        write_tum(update.keyframes, args.trajectory)
        print(f"{args.trajectory}: {len(update.keyframes)} poses (TUM)")
    if picture is not None:
        drawn = args.out.with_suffix(".png") if args.plot is True else args.plot
        picture.write(update, drawn, str(args.bag))
        print(f"{drawn}: mosaic of {len(update.keyframes)} images, path, buildings, links")
    return 0


def _locate(args: argparse.Namespace) -> int:
    from buildloc_matcher.matcher import Matcher
    from buildloc_matcher.reference.database import open_database

    from buildloc.located import locate, table
    from buildloc.mapfile import read_map
    from buildloc.settings import matcher_config_of

    config = matcher_config_of(_settings(args))
    local_map = read_map(args.map)
    answer = locate(Matcher(open_database(args.database, config), config), local_map, args.at, args.top)
    print(json.dumps(answer, indent=2) if args.json else table(answer))
    return 0


def _run(args: argparse.Namespace) -> int:
    from buildloc_mapper.config import MapperConfig
    from buildloc_matcher.reference.database import open_database
    from buildloc_msgs_py.pairing import FrameFault
    from buildloc_msgs_py.types import Fix, NoFix
    from buildloc_segmenter.config import SegmenterConfig

    from buildloc.localizer import Localizer
    from buildloc.records import record
    from buildloc.settings import MAPPER, SEGMENTER, config_of, matcher_config_of

    settings = _settings(args)
    matcher_config = matcher_config_of(settings)
    localizer = Localizer(
        open_database(args.database, matcher_config), config_of(settings, SEGMENTER, SegmenterConfig),
        config_of(settings, MAPPER, MapperConfig), matcher_config,
    )  # fmt: skip
    results, telling = list[Fix | NoFix](), Digest()
    for frame in _frames(args.bag):
        if isinstance(frame, FrameFault):
            results.append(NoFix(frame.stamp_ns, frame.reason))
        else:
            results.append(localizer.process(frame))
        if telling.worth(results[-1]):
            print(describe(results[-1]), flush=True)
    if args.out is not None:
        args.out.write_text("".join(json.dumps(record(result)) + "\n" for result in results))
    fixes = sum(isinstance(result, Fix) for result in results)
    print(f"{fixes} fixes at {len(results)} images")
    return 0


class Digest:
    """Which of many fixes, or absences of one, are worth a line: one per second, and every other reason."""

    def __init__(self) -> None:
        self._told: tuple[int, str | None] | None = None  # when, and why there was no fix

    def worth(self, result: Any) -> bool:
        """Whether the next result is."""
        now = (result.stamp_ns, getattr(result, "reason", None))
        due = self._told is None or now[1] != self._told[1] or now[0] - self._told[0] >= TOLD_NS
        self._told = now if due else self._told
        return due


def describe(result: Any) -> str:
    """One line for a fix or its absence."""
    from buildloc_msgs_py.types import NoFix

    seconds = f"{result.stamp_ns * 1e-9:.3f}"
    if isinstance(result, NoFix):
        return f"{seconds}  no fix: {result.reason}"
    sigma = math.sqrt((result.covariance_enu_m2[0, 0] + result.covariance_enu_m2[1, 1]) / 2.0)
    return f"{seconds}  {result.latitude_deg:.6f} {result.longitude_deg:.6f}  sigma {sigma:.1f} m"


def _replay(args: argparse.Namespace) -> int:
    from buildloc_matcher.reference.database import open_database
    from buildloc_msgs_py.types import Fix

    from buildloc.records import read_fixes
    from buildloc.settings import NODES, REFERENCE_DB, check_settings, matcher_config_of
    from buildloc.supervisor import dds_environment

    os.environ.update(dds_environment())
    from buildloc.replay import replay

    settings = _settings(args)
    check_settings(settings)
    if args.database is not None:
        # The node would stay up without a reference; at a desk that is a replay for nothing.
        open_database(args.database, matcher_config_of(settings, REFERENCE_DB))
        settings[REFERENCE_DB]["database"] = str(args.database.resolve())
    for node in NODES:
        settings[node]["use_sim_time"] = True
    with tempfile.TemporaryDirectory(prefix="buildloc-") as folder:
        fixes = args.out or Path(folder) / "fixes.jsonl"
        played = replay(args.bag, None if args.no_nodes else settings, args.rate, Path(folder), fixes)
        results = read_fixes(fixes)
    report, telling = played.report, Digest()
    accepted = [result for result in results if isinstance(result, Fix)]
    for result in accepted:
        if telling.worth(result):
            print(describe(result))
    print(
        f"{len(accepted)} fixes received on /buildloc/fix; {report.images} images, {report.dropped} dropped, "
        f"{report.frames_unusable} unusable, {report.keyframes} keyframes, {report.keyframes_lost} lost, "
        f"{report.maps} maps, {report.maps_skipped} overtaken; {report.seconds:.1f} s"
    )
    if played.timing is not None:
        print(played.timing.line())
    return 0


def _launch(args: argparse.Namespace) -> int:
    from buildloc.settings import REFERENCE_DB, check_settings
    from buildloc.supervisor import Supervisor, supervise

    settings = _settings(args)
    check_settings(settings)
    if args.database is not None:
        settings[REFERENCE_DB]["database"] = str(args.database.resolve())
    with tempfile.TemporaryDirectory(prefix="buildloc-") as folder:
        return supervise(Supervisor(settings, Path(folder)))


def _command(
    subparsers: Any, name: str, text: str, run: Run, *arguments: tuple[tuple[str, ...], dict[str, Any]]
) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = subparsers.add_parser(name, help=text, description=text)
    for flags, options in arguments:
        parser.add_argument(*flags, **options)
    parser.set_defaults(run=run)
    return parser


def _argument(*flags: str, **options: Any) -> tuple[tuple[str, ...], dict[str, Any]]:
    return flags, options


def parser() -> argparse.ArgumentParser:
    """All commands, those that other packages register under ``buildloc.commands`` among them."""
    top = argparse.ArgumentParser(prog="buildloc", description="position from the pattern of buildings below")
    top.add_argument(
        "--version", action="version", version=f"buildloc {importlib.metadata.version('buildloc')}"
    )
    commands = top.add_subparsers(dest="command", required=True)
    refdb = commands.add_parser("refdb", help="reference databases of building footprints")
    refdb_commands = refdb.add_subparsers(dest="refdb_command", required=True)
    bag = _argument("bag", type=Path, help="rosbag2 folder or MCAP file")
    database = _argument("--database", type=Path, required=True, help="reference database")
    _command(
        refdb_commands, "fetch", "download the building footprints of an area", _refdb_fetch,
        _argument("--source", choices=("microsoft", "overture"), required=True, help="whose footprints"),
        _argument(
            "--center", type=_location, required=True, metavar="LAT,LON",
            help="middle of the area; in the south write --center=-33.9,151.2",
        ),
        _argument("--radius-km", type=float, required=True, help="how far around the centre, km"),
        _argument("-o", "--out", type=Path, required=True, help="folder for the files and their manifest"),
        _argument("--index-url", help="Microsoft's dataset-links.csv, if it has moved or is mirrored"),
    )  # fmt: skip
    preset = _argument("--preset", help="parameters of the matcher: default or paper")
    with_settings = [
        _command(
            refdb_commands, "build", "describe building footprints", _refdb_build,
            _argument("sources", type=Path, nargs="+", help="footprint files or folders, the best first"),
            _argument("-o", "--out", type=Path, required=True, help="database to write"),
            _argument("--center", type=_location, metavar="LAT,LON", help="keep what lies around here"),
            _argument("--radius-km", type=float, help="how far around the centre, km"),
            _argument("--bbox", type=_box, metavar="WEST,SOUTH,EAST,NORTH", help="keep what lies here"),
            _argument("--tile-km", type=float, default=20.0, help="side of a tile, km (default 20)"),
            _argument("--scheduler", metavar="ADDRESS", help="Dask scheduler; default: processes here"),
            _argument("--licence", help="licence of the sources, where their files do not state it"),
        ),
        _command(
            refdb_commands, "info", "what a database holds", _refdb_info, _argument("database", type=Path)
        ),
        _command(
            commands, "segment", "building masks and outlines of images, or of a bag's keyframes", _segment,
            _argument("inputs", type=Path, nargs="+", metavar="INPUT", help="images, folders of them, a bag"),
            _argument("-o", "--out", type=Path, required=True, help="folder for the results"),
            _argument("--gsd", type=_metres, metavar="M", help="metres per pixel of the images"),
            _argument("--overlay", action="store_true", help="the images with the outlines too"),
        ),
        _command(
            commands, "map", "map file and trajectory of a bag", _map, bag,
            _argument("-o", "--out", type=Path, required=True, help="GeoJSON or GeoParquet, local metres"),
            _argument("--trajectory", type=Path, help="keyframe poses in TUM format"),
            _argument(
                "--plot", type=Path, nargs="?", const=True, metavar="FILE",
                help="picture of the map (default: beside --out, .png)",
            ),
            _argument("--registration", metavar="NAME", help="sift, xfeat, coarse_loftr or loftr"),
            _argument("--registration-model", type=Path, help="ONNX file of its weights; none for sift"),
        ),
        _command(
            commands, "locate", "ranked candidates and fix of a map file", _locate,
            _argument("database", type=Path, help="reference database"),
            _argument("map", type=Path, help="building polygons in local metres, GeoJSON or GeoParquet"),
            _argument("--at", type=_point, metavar="X,Y", help="local point to place (default: the mean)"),
            _argument("--top", type=_count, default=10, metavar="K", help="candidates listed (default 10)"),
            preset,
            _argument("--json", action="store_true", help="machine-readable answer"),
        ),
        _command(
            commands, "run", "fixes of a bag, offline and deterministic", _run, bag, database,
            preset,
            _argument("-o", "--out", type=Path, help="JSON lines, one per image"),
        ),
        _command(
            commands, "replay", "play a bag into the live nodes", _replay, bag,
            _argument("--database", type=Path, help="reference database"),
            _argument("--rate", type=float, default=1.0, help="speed relative to the recording"),
            _argument("-o", "--out", type=Path, help="JSON lines of what arrived on /buildloc/fix"),
            _argument("--no-nodes", action="store_true", help="the nodes run already, elsewhere"),
            preset,
        ),
        _command(
            commands, "launch", "start the nodes and keep them together until SIGINT", _launch,
            _argument("--database", type=Path, help="reference database"),
            preset,
        ),
    ]  # fmt: skip
    for command in with_settings:
        _settings_arguments(command)
    for entry in sorted(importlib.metadata.entry_points(group=EXTENSIONS), key=lambda e: e.name):
        text, add_arguments, run = entry.load()
        added = _command(commands, entry.name, text, run)
        add_arguments(added)
    return top


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command; expected errors are one line and status 2."""
    args = parser().parse_args(argv)
    run: Run = args.run
    try:
        return run(args)
    except BuildlocError as error:
        _progress_end()
        print(f"error: {error}", file=sys.stderr)
        return 2
    except BrokenPipeError:  # the reader of our output, `head` say, has seen enough
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
