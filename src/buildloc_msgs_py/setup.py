"""Build with colcon (ament_python) or pip."""

from setuptools import find_packages, setup

package = "buildloc_msgs_py"

setup(
    name=package,
    version="0.1.0",
    description="Shared vocabulary of buildloc: types, footprint metrics, topics, encode and decode",
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
    install_requires=["numpy>=1.26,<3", "opencv-python-headless>=4.8,<6", "shapely>=2.0,<3"],
    extras_require={
        "ros": ["ros-jazzy-rclpy[fastrtps]>=7.1,<8", "ros-jazzy-common-interfaces>=5.3,<6"],
        "test": ["pytest"],
    },
    zip_safe=False,
)
