"""The ROS 2 package ``graphvio_ros``, built by colcon (ament_python)."""

from setuptools import setup

NAME = "graphvio_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/graphvio.launch.py"]),
        (f"share/{NAME}/config", ["config/graphvio.yaml"]),
        (f"share/{NAME}/rviz", ["rviz/graphvio.rviz"]),
    ],
    install_requires=["setuptools", "graphvio[ros2]"],
    zip_safe=True,
    entry_points={"console_scripts": [f"node = {NAME}.node:main"]},
)
