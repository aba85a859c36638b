"""Every package declares what it is, what it needs and what it ships, once for pip and once for ROS."""

import ast
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

SRC = Path(__file__).parents[1] / "src"
PACKAGES = sorted(path.parent.name for path in SRC.glob("*/package.xml"))
DISTRIBUTIONS = {
    "cv2": "opencv-python-headless",
    "faiss": "faiss-cpu",
    "yaml": "PyYAML",
}  # where the name differs from the module's


def is_ros(name: str) -> bool:
    return name in {"rclpy", "launch", "launch_ros", "ament_index_python", "std_srvs"} or name.endswith(
        ("_msgs", "_interfaces")
    )


def imports(package: str) -> set[str]:
    """Top-level modules that a package imports, without itself and the standard library."""
    found: set[str] = set()
    for path in (SRC / package / package).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Import):
                found |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom):
                found.add(str(node.module).split(".")[0])
    return found - sys.stdlib_module_names - {package}


def setup_arguments(package: str) -> dict[str, Any]:
    """The literal keyword arguments of setup()."""
    tree = ast.parse((SRC / package / "setup.py").read_text(encoding="utf-8"))
    call = next(
        node
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "setup"
    )
    arguments = {}
    for keyword in call.keywords:
        try:
            arguments[str(keyword.arg)] = ast.literal_eval(keyword.value)
        except ValueError:
            continue
    return arguments


def manifest(package: str) -> ElementTree.Element:
    return ElementTree.parse(SRC / package / "package.xml").getroot()


def requirement(text: str) -> str:
    """The name in a requirement such as ``numpy>=2,<3``."""
    return text.split(">")[0].split("=")[0].split("[")[0].strip()


def test_all_six_packages_are_here() -> None:
    names = ("", "_eval", "_mapper", "_matcher", "_msgs_py", "_segmenter")
    assert [f"buildloc{name}" for name in names] == PACKAGES


@pytest.mark.parametrize("package", PACKAGES)
def test_setup_and_manifest_agree(package: str) -> None:
    setup, xml = setup_arguments(package), manifest(package)
    assert xml.findtext("name") == package
    assert xml.findtext("version") == setup["version"] == setup_arguments("buildloc")["version"]
    assert xml.findtext("license") == setup["license"] == "Apache-2.0"
    assert xml.findtext("description") == setup["description"]
    assert xml.findtext("export/build_type") == "ament_python"
    assert (SRC / package / "resource" / package).is_file()
    assert f"$base/lib/{package}" in (SRC / package / "setup.cfg").read_text(encoding="utf-8")


@pytest.mark.parametrize("package", PACKAGES)
def test_pip_requirements_are_the_imports(package: str) -> None:
    needed = {DISTRIBUTIONS.get(name, name) for name in imports(package) if not is_ros(name)}
    assert {requirement(text) for text in setup_arguments(package)["install_requires"]} == needed


@pytest.mark.parametrize("package", PACKAGES)
def test_manifest_covers_the_imports(package: str) -> None:
    needed = {name for name in imports(package) if is_ros(name) or name in PACKAGES}
    declared = {str(element.text) for element in manifest(package).findall("exec_depend")}
    assert needed <= declared
    assert declared & set(PACKAGES) <= needed


@pytest.mark.parametrize("package", PACKAGES)
def test_entry_points_exist(package: str) -> None:
    for group in setup_arguments(package).get("entry_points", {}).values():
        for entry in group:
            module, name = entry.split("=")[1].strip().split(":")
            path = SRC / package / (module.replace(".", "/") + ".py")
            tree = ast.parse(path.read_text(encoding="utf-8"))
            defined = {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}
            defined |= {ast.unparse(node.targets[0]) for node in tree.body if isinstance(node, ast.Assign)}
            assert name in defined, entry


@pytest.mark.parametrize("package", PACKAGES)
def test_wheel_holds_every_file(package: str, tmp_path: Path) -> None:
    source = tmp_path / package
    shutil.copytree(
        SRC / package, source, ignore=shutil.ignore_patterns("build", "*.egg-info", "__pycache__", "test")
    )
    command = [sys.executable, "setup.py", "-q", "bdist_wheel", "--dist-dir", str(tmp_path)]
    subprocess.run(command, cwd=source, check=True, capture_output=True, timeout=120)
    with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as wheel:
        packed = set(wheel.namelist())
    wanted = {str(path.relative_to(source)) for path in (source / package).rglob("*") if path.is_file()}
    assert wanted - packed == set()
    assert f"{package}-0.1.0.data/data/share/{package}/package.xml" in packed
