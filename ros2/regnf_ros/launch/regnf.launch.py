"""Starts the node: ros2 launch regnf_ros regnf.launch.py objects:='chair=SHA256' depth:=/camera/depth/image_rect ..."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

ARGUMENTS = {
    "server": ("http://127.0.0.1:8080", "Address of the regnf service."),
    "token_file": ("", "File with the service's access token. Default: the environment variable REGNF_API_TOKEN."),
    "scene": ("", "SHA-256 of the room's field. It is needed only for boxes in space, not for images."),
    "objects": ("", 'CLASS=SHA256 of each object, separated by spaces; or JSON: {"CLASS": "SHA256"}.'),
    "object_unit": ("auto", "Unit of the objects' fields: m, cm, mm, in; auto: from their size; free: unknown."),
    "map_frame": ("map", "The fixed frame of the poses: the frame of the room's field."),
    "dataparser_transforms": ("", "dataparser_transforms.json, if the room's field is in its trainer's frame."),
    "scale_tolerance": ("", "Relative tolerance of the objects' scale, for example 0.03."),
    "up_axis": ("", "Up axis of room and objects, x, y or z, if it is known."),
}
TOPICS = {
    "depth": ("depth/image", "Depth images, aligned to the images in which detections are made."),
    "camera_info": ("depth/camera_info", "Camera info of the depth images."),
    "color": ("color/image", "Color images for the picture of a result."),
    "detections_2d": ("detections_2d", "vision_msgs/Detection2DArray."),
    "yolo": ("yolo/detections", "yolo_msgs/DetectionArray."),
    "detections": ("detections", "Boxes in space, vision_msgs/Detection3DArray."),
}


def generate_launch_description():
    declared = [
        DeclareLaunchArgument(name, default_value=value, description=told)
        for name, (value, told) in (ARGUMENTS | TOPICS).items()
    ]
    parameters = {name: ParameterValue(LaunchConfiguration(name), value_type=str) for name in ARGUMENTS}
    topics = [(topic, LaunchConfiguration(name)) for name, (topic, _) in TOPICS.items()]
    node = Node(
        package="regnf_ros", executable="register_objects", name="regnf", parameters=[parameters], remappings=topics
    )
    return LaunchDescription([*declared, node])
