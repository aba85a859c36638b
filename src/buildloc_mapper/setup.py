"""Build with colcon (ament_python) or pip."""

from setuptools import find_packages, setup

package = "buildloc_mapper"

setup(
    name=package,
    version="0.1.0",
    description="Frames and masks to a map of buildings: registration, pose graph, fusion",
    license="Apache-2.0",
    maintainer="buildloc maintainers",
    maintainer_email="maintainers@buildloc.example",
    python_requires=">=3.11",
    packages=find_packages(include=[package, f"{package}.*"]),
    package_data={package: ["py.typed"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
    ],
    install_requires=[
        "buildloc_msgs_py",
        "numpy>=1.26,<3",
        "opencv-python-headless>=4.8,<6",
        "shapely>=2.0,<3",
        "gtsam>=4.3,<5",
        "onnxruntime>=1.18,<2",
    ],
    extras_require={"ros": ["buildloc_msgs_py[ros]"], "test": ["pytest"]},
    entry_points={
        "console_scripts": ["mapper_node = buildloc_mapper.mapper_node:main"],
    },
    zip_safe=False,
)
