"""The node behind the ROS driver of a RealSense; other cameras have other topics."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

TOPICS = {
    "depth": ("/camera/camera/depth/image_rect_raw", "depth image, sensor_msgs/Image"),
    "camera_info": ("/camera/camera/depth/camera_info", "its intrinsics, sensor_msgs/CameraInfo"),
    "points": ("/camera/camera/depth/color/points", "cloud in an optical frame, sensor_msgs/PointCloud2"),
    "joint_states": ("/joint_states", "known joints, sensor_msgs/JointState, where the parameter known_joints is true"),
}


def generate_launch_description() -> LaunchDescription:
    """Arguments are the topics and the file of parameters."""
    parameters = str(Path(get_package_share_directory("mereo_ros")) / "config" / "mereo.yaml")
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=topic, description=what)
                for name, (topic, what) in TOPICS.items()
            ),
            DeclareLaunchArgument("parameters", default_value=parameters, description="file of the node's parameters"),
            Node(
                package="mereo_ros",
                executable="track",
                name="mereo",
                output="screen",
                parameters=[LaunchConfiguration("parameters")],
                remappings=[(name, LaunchConfiguration(name)) for name in TOPICS],
            ),
        ]
    )
