"""Start the graph: `ros2 launch brainshift_ros brainshift.launch.py atlas:=atlas.h5 patient:=patient.h5 [image:=T1.nii.gz]`.

The nodes come from `brainshift_ros.graph`, the environment from `brainshift_ros.runner`: the same as for `brainshift run`.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, SetEnvironmentVariable
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from brainshift_ros import graph
from brainshift_ros.resources import PACKAGE, resource
from brainshift_ros.runner import ros_environment

PROFILE = "FASTDDS_DEFAULT_PROFILES_FILE"

#: Launch argument -> (node, parameter, default, description).
ARGUMENTS = {
    "atlas": ("atlas_loader", "atlas_file", None, "atlas file (HDF5)"),
    "patient": ("lrs", "patient_file", None, "patient file (HDF5)"),
    "scene": ("lrs", "scene_file", "", "scene (YAML): a scan without a pose is searched for near its craniotomy"),
    "fiducials": ("lrs", "fiducials_file", "", "paired fiducials (YAML) that the registration starts from"),
    "guides": ("lrs", "guides_file", "", "marks in two scans (YAML) that lrs/guide reads"),
    "image": ("inverse", "image_file", "", "T1 MR (NIfTI) for inverse/warp_image"),
    "output_dir": ("inverse", "output_dir", "out/case", "folder that inverse/warp_image writes to"),
}


def node_action(node):
    """Node of the graph, with the parameter file first and the launch arguments after it."""
    own = {
        parameter: ParameterValue(LaunchConfiguration(argument), value_type=str)
        for argument, (name, parameter, _, _) in ARGUMENTS.items()
        if name == node.name
    }
    return Node(
        package=PACKAGE,
        executable=node.name,
        name=node.name,
        output="screen",
        respawn=True,
        respawn_delay=1.0,
        parameters=[LaunchConfiguration("params"), *([own] if own else [])],
    )


def generate_launch_description():
    """Build the description that `ros2 launch` asks for."""
    arguments = [
        DeclareLaunchArgument(name, description=text, **({} if default is None else {"default_value": default}))
        for name, (_, _, default, text) in ARGUMENTS.items()
    ]
    params = DeclareLaunchArgument(
        "params", default_value=str(resource("config/nodes.yaml")), description="ROS 2 parameter file (YAML)"
    )
    transport = SetEnvironmentVariable(PROFILE, ros_environment()[PROFILE])
    return LaunchDescription([*arguments, params, transport, *map(node_action, graph.NODES)])
