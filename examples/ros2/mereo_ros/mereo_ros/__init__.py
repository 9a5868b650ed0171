"""A node of ROS 2 that tracks an object by mereo."""
