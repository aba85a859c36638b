"""Build with colcon (ament_python) or pip."""

from pathlib import Path

from setuptools import find_packages, setup

package = "buildloc"


def shared(folder: str) -> tuple[str, list[str]]:
    """A folder of the package, installed under share/ as well for ROS tools."""
    files = sorted(str(path) for path in Path(package, folder).glob("*.*"))
    return f"share/{package}/{folder}", files


setup(
    name=package,
    version="0.1.0",
    description="GNSS-free position from building patterns: command line, offline localizer, replay, launch",
    license="Apache-2.0",
    maintainer="buildloc maintainers",
    maintainer_email="maintainers@buildloc.example",
    python_requires=">=3.11",
    packages=find_packages(include=[package, f"{package}.*"]),
    package_data={package: ["py.typed", "config/*", "launch/*", "layouts/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
        shared("config"),
        shared("launch"),
        shared("layouts"),
    ],
    install_requires=[
        "buildloc_msgs_py",
        "buildloc_segmenter",
        "buildloc_mapper",
        "buildloc_matcher",
        "numpy>=1.26,<3",
        "opencv-python-headless>=4.8,<6",
        "shapely>=2.0,<3",
        "geopandas>=1.0,<2",
        "pyarrow>=14,<30",
        "pyogrio>=0.10,<1",
        "PyYAML>=6,<7",
        "matplotlib>=3.6,<4",
        "rosbags>=0.11,<0.12",
    ],
    extras_require={"ros": ["buildloc_msgs_py[ros]"], "test": ["pytest"]},
    entry_points={
        "console_scripts": ["buildloc = buildloc.cli:main"],
    },
    zip_safe=False,
)
