"""Build with colcon (ament_python) or pip."""

from setuptools import find_packages, setup

package = "buildloc_segmenter"

setup(
    name=package,
    version="0.1.0",
    description="Buildings in an image: keyframe policy, ONNX inference, mask clean-up",
    license="Apache-2.0",
    maintainer="buildloc maintainers",
    maintainer_email="maintainers@buildloc.example",
    python_requires=">=3.11",
    packages=find_packages(include=[package, f"{package}.*"]),
    package_data={package: ["py.typed", "models/*.onnx", "models/*.md"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
    ],
    install_requires=[
        "buildloc_msgs_py",
        "numpy>=1.26,<3",
        "scipy>=1.11,<2",
        "opencv-python-headless>=4.8,<6",
        "onnxruntime>=1.18,<2",
        "shapely>=2.0,<3",
    ],
    extras_require={"ros": ["buildloc_msgs_py[ros]"], "test": ["pytest"]},
    entry_points={
        "console_scripts": ["segmenter_node = buildloc_segmenter.segmenter_node:main"],
    },
    zip_safe=False,
)
