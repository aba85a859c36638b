"""Who may import whom (the design's layout), read from the syntax tree of every module under src/."""

import ast
import re
from pathlib import Path

import pytest

SRC = Path(__file__).parents[1] / "src"

VOCABULARY = {"buildloc_msgs_py"}
STAGES = {"buildloc_segmenter", "buildloc_mapper", "buildloc_matcher"}
MAY_IMPORT = {
    "buildloc_msgs_py": set(),
    "buildloc_segmenter": VOCABULARY,
    "buildloc_mapper": VOCABULARY,
    "buildloc_matcher": VOCABULARY,
    "buildloc": VOCABULARY | STAGES,
    "buildloc_eval": VOCABULARY | STAGES | {"buildloc"},
}
ROS = re.compile(
    r"rclpy|launch|launch_ros|ament_index_python|builtin_interfaces|rcl_interfaces|std_srvs|\w+_msgs"
)
MAY_IMPORT_ROS = re.compile(
    r"\w+\.\w+_node"
    r"|buildloc_msgs_py\.(encode|qos|ros_node)"
    r"|buildloc\.(replay|fix_listener)"
    r"|buildloc\.launch\..+"
)
# One module for the segmentation network, one for all matching networks, one for the baseline NetVLAD, and
# one for the pose graph.
ONLY_IN = {
    "onnxruntime": {"buildloc_segmenter.network", "buildloc_mapper.network", "buildloc_eval.paper.netvlad"},
    "gtsam": {"buildloc_mapper.pose_graph"},
}
WORLD_SIMULATION = {
    f"buildloc_eval.{name}"
    for name in ("world", "town", "flight", "camera", "sim", "orthos", "paper.flights", "paper.texture")
}
NAMES_GROUND_TRUTH = {"buildloc_msgs_py.topics"}  # where the topic is spelt
NODE_LINES = 160


def imported(source: str) -> set[str]:
    """Dotted names of all that a module imports: ``from a import b`` gives ``a`` and ``a.b``."""
    names: set[str] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports are not used in this project"
            names |= {str(node.module)} | {f"{node.module}.{alias.name}" for alias in node.names}
        elif isinstance(node, ast.Call) and getattr(node.func, "attr", "") == "import_module":
            names |= {str(arg.value) for arg in node.args if isinstance(arg, ast.Constant)}
    return names


def reads_ground_truth(source: str) -> bool:
    """Whether a module names the ground truth's topic or imports a module of that name."""
    return any(
        "GROUND_TRUTH" in (getattr(node, "attr", ""), getattr(node, "id", ""))
        or (isinstance(node, ast.Constant) and str(node.value).startswith("/ground_truth"))
        for node in ast.walk(ast.parse(source))
    ) or any("truth" in name.lower() for name in imported(source))


def violations(module: str, source: str) -> list[str]:
    """What ``module`` (dotted name) does that the rules forbid."""
    package = module.split(".")[0]
    roots = {name.split(".")[0] for name in imported(source)}
    found = [
        f"{module} imports {root}"
        for root in sorted(roots & MAY_IMPORT.keys() - MAY_IMPORT[package] - {package})
    ]
    if not MAY_IMPORT_ROS.fullmatch(module):
        found += [
            f"{module} imports {root}, but is no ROS module" for root in sorted(roots) if ROS.fullmatch(root)
        ]
    found += [
        f"{module} imports {root}, which belongs in {', '.join(sorted(places))}"
        for root, places in ONLY_IN.items()
        if root in roots and module not in places
    ]
    if "training" in roots or "torch" in roots:
        found.append(f"{module} imports training code")
    if package != "buildloc_eval" and module not in NAMES_GROUND_TRUTH and reads_ground_truth(source):
        found.append(f"{module} reads ground truth")
    if module.endswith("_node") and source.count("\n") > NODE_LINES and package != "buildloc_msgs_py":
        found.append(f"{module} has {source.count(chr(10))} lines; a node file has at most {NODE_LINES}")
    return found


def reachable(start: str, sources: dict[str, str]) -> set[str]:
    """The modules of ours that importing ``start`` loads, itself and the packages above them included."""
    seen: set[str] = set()
    waiting = [start]
    while waiting:
        module = waiting.pop()
        if module in seen or module not in sources:
            continue
        seen.add(module)
        waiting += [*imported(sources[module]), module.rpartition(".")[0]]
    return seen


def simulation_violations(sources: dict[str, str]) -> list[str]:
    """World simulation that reaches descriptors or matching, however many imports away."""
    return [
        f"{start} reaches {module}"
        for start in sorted(WORLD_SIMULATION & sources.keys())
        for module in sorted(reachable(start, sources))
        if module.startswith("buildloc_matcher")
    ]


def _sources() -> dict[str, str]:
    sources = {}
    for package in MAY_IMPORT:
        for path in sorted((SRC / package / package).rglob("*.py")):
            module = ".".join(path.relative_to(SRC / package).with_suffix("").parts).removesuffix(".__init__")
            sources[module] = path.read_text(encoding="utf-8")
    return sources


SOURCES = _sources()


def test_every_package_is_read() -> None:
    assert {module.split(".")[0] for module in SOURCES} == MAY_IMPORT.keys()


@pytest.mark.parametrize("module", SOURCES)
def test_module_keeps_the_rules(module: str) -> None:
    assert not violations(module, SOURCES[module])


def test_world_simulation_never_reaches_the_matcher() -> None:
    assert not simulation_violations(SOURCES)


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("buildloc_msgs_py.types", "import buildloc_mapper"),
        ("buildloc_mapper.fusion", "from buildloc_matcher.geometry import wrap"),
        ("buildloc_matcher.matcher", "def f():\n    from buildloc.cli import main\n"),
        ("buildloc.cli", "import buildloc_eval.cli"),
        ("buildloc.cli", "import importlib\nimportlib.import_module('buildloc_eval.cli')"),
        ("buildloc_matcher.session", "import rclpy"),
        ("buildloc_matcher.session", "from sensor_msgs.msg import Image"),
        ("buildloc.cli", "from std_srvs.srv import Trigger"),
        ("buildloc_segmenter.keyframes", "import onnxruntime"),
        ("buildloc_mapper.xfeat", "import onnxruntime"),
        ("buildloc_mapper.fusion", "import gtsam"),
        ("buildloc_segmenter.segmenter_node", "import torch"),
        ("buildloc_matcher.session", "from buildloc_msgs_py import topics\nprint(topics.GROUND_TRUTH)"),
        ("buildloc.replay", "TOPIC = '/ground_truth/pose'"),
        ("buildloc.offline", "from buildloc_eval.truth import read_truth"),
        ("buildloc_mapper.mapper_node", "\n" * (NODE_LINES + 1)),
    ],
)
def test_rules_catch(module: str, source: str) -> None:
    assert violations(module, source)


@pytest.mark.parametrize(
    ("module", "source"),
    [
        ("buildloc_matcher.matcher_node", "import rclpy\nfrom buildloc_msgs_py import encode"),
        ("buildloc_mapper.pose_graph", "import gtsam"),
        (
            "buildloc_eval.metrics",
            "from buildloc_msgs_py.topics import GROUND_TRUTH\nimport buildloc.offline",
        ),
        ("buildloc.launch.buildloc.launch", "from launch_ros.actions import Node"),
    ],
)
def test_rules_allow(module: str, source: str) -> None:
    assert not violations(module, source)


def test_simulation_rule_catches_a_detour() -> None:
    sources = {
        "buildloc_eval.world": "from buildloc_eval.helper import nearest",
        "buildloc_eval.helper": "from buildloc_matcher.geometry import wrap",
        "buildloc_matcher.geometry": "",
    }
    assert simulation_violations(sources) == ["buildloc_eval.world reaches buildloc_matcher.geometry"]
