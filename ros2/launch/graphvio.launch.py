"""Start the node, and RViz with ``rviz:=true``."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def start_node(context: LaunchContext) -> list[Node]:
    """Start the node; an argument that is not given leaves what the file of parameters says."""
    values = {name: LaunchConfiguration(name).perform(context) for name in ("source", "rig")}
    given = {name: value for name, value in values.items() if value}
    return [
        Node(
            package="graphvio_ros",
            executable="node",
            name="graphvio",
            namespace=LaunchConfiguration("namespace"),
            parameters=[LaunchConfiguration("params_file"), *([given] if given else [])],
            output="screen",
        )
    ]


def generate_launch_description() -> LaunchDescription:
    """Describe the launch: arguments, the node, RViz."""
    share = Path(get_package_share_directory("graphvio_ros"))
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "source", default_value="", description="Live source; empty takes that of params_file."
            ),
            DeclareLaunchArgument("rig", default_value="", description="Rig file; empty takes that of params_file."),
            DeclareLaunchArgument("namespace", default_value="", description="Namespace of the node."),
            DeclareLaunchArgument(
                "params_file", default_value=str(share / "config/graphvio.yaml"), description="Parameters of the node."
            ),
            DeclareLaunchArgument("rviz", default_value="false", description="Whether to start RViz."),
            OpaqueFunction(function=start_node),
            Node(
                package="rviz2",
                executable="rviz2",
                arguments=["-d", str(share / "rviz/graphvio.rviz")],
                condition=IfCondition(LaunchConfiguration("rviz")),
            ),
        ]
    )
