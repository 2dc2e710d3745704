"""The ROS 2 package `ssrvlad_ros`, for `colcon build`."""

from setuptools import setup

setup(
    name="ssrvlad_ros",
    version="0.1.0",
    packages=["ssrvlad_ros"],
    package_data={"ssrvlad_ros": ["golden.npz"]},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/ssrvlad_ros"]),
        ("share/ssrvlad_ros", ["package.xml"]),
    ],
    install_requires=["setuptools", "ssrvlad-torch"],
    entry_points={"console_scripts": ["loops = ssrvlad_ros.loop_node:main"]},
)
