"""Start the node, and RViz with ``rviz:=true``."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """Describe the launch: arguments, the node, RViz."""
    share = Path(get_package_share_directory("graphvio_ros"))
    return LaunchDescription(
        [
            DeclareLaunchArgument("source", default_value="ros2:", description="Live source of graphvio."),
            DeclareLaunchArgument("rig", default_value="", description="Rig file; empty takes that of the source."),
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the node."),
            DeclareLaunchArgument(
                "params_file", default_value=str(share / "config/graphvio.yaml"), description="Parameters of the node."
            ),
            DeclareLaunchArgument("rviz", default_value="false", description="Whether to start RViz."),
            Node(
                package="graphvio_ros",
                executable="node",
                name="graphvio",
                namespace=LaunchConfiguration("namespace"),
                parameters=[
                    LaunchConfiguration("params_file"),
                    {"source": LaunchConfiguration("source"), "rig": LaunchConfiguration("rig")},
                ],
                output="screen",
            ),
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=["-d", str(share / "rviz/graphvio.rviz")],
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
        ]
    )
