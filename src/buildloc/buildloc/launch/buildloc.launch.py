"""The node graph: ros2 launch buildloc buildloc.launch.py database:=FILE [params:=FILE]."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

GRAPH = (
    ("buildloc_matcher", "reference_db_node"),
    ("buildloc_segmenter", "segmenter_node"),
    ("buildloc_mapper", "mapper_node"),
    ("buildloc_matcher", "matcher_node"),
)


def generate_launch_description() -> LaunchDescription:
    """The four nodes with one parameter file; when one dies, all stop."""
    default = Path(get_package_share_directory("buildloc")) / "config" / "buildloc.yaml"
    parameters = [
        LaunchConfiguration("params"),
        {"use_sim_time": LaunchConfiguration("use_sim_time")},
    ]
    nodes = [
        Node(
            package=package,
            executable=name,
            name=name,
            parameters=[*parameters, {"database": LaunchConfiguration("database")}]
            if name == "reference_db_node"
            else parameters,
            output="screen",
            on_exit=Shutdown(),
        )
        for package, name in GRAPH
    ]
    return LaunchDescription(
        [
            DeclareLaunchArgument("params", default_value=str(default)),
            DeclareLaunchArgument("database", default_value=""),
            DeclareLaunchArgument("use_sim_time", default_value="false"),
            *nodes,
        ]
    )
