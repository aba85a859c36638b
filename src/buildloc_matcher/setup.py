"""Build with colcon (ament_python) or pip."""

from setuptools import find_packages, setup

package = "buildloc_matcher"

setup(
    name=package,
    version="0.1.0",
    description="A map of buildings against the reference database: star descriptors, candidates, fix",
    license="Apache-2.0",
    maintainer="buildloc maintainers",
    maintainer_email="maintainers@buildloc.example",
    python_requires=">=3.11",
    packages=find_packages(include=[package, f"{package}.*"]),
    package_data={package: ["py.typed", "calibration.json"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{package}"]),
        (f"share/{package}", ["package.xml"]),
    ],
    install_requires=[
        "buildloc_msgs_py",
        "numpy>=1.26,<3",
        "scipy>=1.11,<2",
        "shapely>=2.0,<3",
        "pyproj>=3.6,<4",
        "geopandas>=1.0,<2",
        "pyogrio>=0.10,<1",
        "pyarrow>=14,<30",
        "numba>=0.60,<0.70",
        "requests>=2.31,<3",
        "urllib3>=2.0,<3",
        "mercantile>=1.2,<2",
        "overturemaps>=1.0.2,<2",
        "dask>=2024.8,<2027",
        "distributed>=2024.8,<2027",
    ],
    extras_require={
        "ros": ["buildloc_msgs_py[ros]"],
        "dashboard": ["bokeh>=3.1,<4"],  # pages for the Dask dashboard of a build
        "test": ["pytest"],
    },
    entry_points={
        "console_scripts": [
            "matcher_node = buildloc_matcher.matcher_node:main",
            "reference_db_node = buildloc_matcher.reference_db_node:main",
        ],
    },
    zip_safe=False,
)
