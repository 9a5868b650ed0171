"""Package of ROS 2, built by colcon (ament_python)."""

from glob import glob

from setuptools import setup

NAME = "mereo_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", glob("launch/*.launch.py")),
        (f"share/{NAME}/config", glob("config/*.yaml")),
    ],
    install_requires=["setuptools"],  # mereo comes from pip, which rosdep does not know
    zip_safe=True,
    maintainer="The mereo authors",
    maintainer_email="mereo@example.org",
    description="Finds a known deformable object in depth images or point clouds, and publishes where it is.",
    license="MIT",
    entry_points={"console_scripts": [f"track = {NAME}.node:main"]},
)
