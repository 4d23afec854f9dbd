"""Starts the node: ros2 launch regnf_ros regnf.launch.py scene:=SHA256 objects:='chair=SHA256'"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

ARGUMENTS = {
    "server": ("http://127.0.0.1:8080", "Address of the regnf service."),
    "token_file": ("", "File with the service's access token. Without it that of the variable REGNF_API_TOKEN."),
    "scene": ("", "SHA-256 of the room's field."),
    "objects": ("", 'CLASS=SHA256 of each object, with blanks between them; or JSON: {"CLASS": "SHA256"}.'),
    "map_frame": ("map", "The fixed frame that the room's field is in."),
    "dataparser_transforms": ("", "dataparser_transforms.json, if the room's field is in its trainer's frame."),
    "scale_tolerance": ("", "The objects' fields are in meters, give or take this share: 0.03 for instance."),
    "up_axis": ("", "x, y or z: the vertical axis of room and objects, if it is known."),
}


def generate_launch_description():
    declared = [
        DeclareLaunchArgument(name, default_value=value, description=told) for name, (value, told) in ARGUMENTS.items()
    ]
    parameters = {name: ParameterValue(LaunchConfiguration(name), value_type=str) for name in ARGUMENTS}
    node = Node(package="regnf_ros", executable="register_objects", name="regnf", parameters=[parameters])
    return LaunchDescription([*declared, node])
