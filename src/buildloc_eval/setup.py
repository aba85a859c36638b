"""Build with colcon (ament_python) or pip."""

from setuptools import find_packages, setup

package = "buildloc_eval"

setup(
    name=package,
    version="0.1.0",
    description="Worlds, flights, baselines and reports for buildloc; the only reader of ground truth",
    license="Apache-2.0",
    maintainer="buildloc maintainers",
    maintainer_email="maintainers@buildloc.example",
    python_requires=">=3.11",
    packages=find_packages(include=[package, f"{package}.*"]),
    package_data={package: ["py.typed", "*.json"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
    ],
    install_requires=[
        "buildloc_msgs_py",
        "buildloc_segmenter",
        "buildloc_mapper",
        "buildloc_matcher",
        "buildloc",
        "numpy>=1.26,<3",
        "opencv-python-headless>=4.8,<6",
        "shapely>=2.0,<3",
        "pyproj>=3.6,<4",
        "geopandas>=1.0,<2",
        "pandas>=2.2,<4",
        "rosbags>=0.11,<0.12",
        "matplotlib>=3.6,<4",
        "scipy>=1.11,<2",
        "faiss-cpu>=1.8,<2",
        "onnxruntime>=1.18,<2",
        "evo>=1.31,<2",
    ],
    extras_require={"ros": ["buildloc_msgs_py[ros]"], "test": ["pytest"]},
    entry_points={
        "buildloc.commands": [
            "sim = buildloc_eval.cli:sim_command",
            "eval = buildloc_eval.cli:eval_command",
            "demo = buildloc_eval.cli:demo_command",
        ],
    },
    zip_safe=False,
)
