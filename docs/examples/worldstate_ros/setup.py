"""Package of ROS 2 (ament_python) with one node."""

from setuptools import setup

NAME = "worldstate_ros"

setup(
    name=NAME,
    version="0.4.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/worldstate.launch.py"]),
        (f"share/{NAME}/config", ["config/worldstate.yaml"]),
    ],
    install_requires=["setuptools", "worldstate>=0.4"],
    zip_safe=True,
    maintainer="The worldstate authors",
    maintainer_email="worldstate@example.org",
    description="A node around worldstate's Listener.",
    license="Apache-2.0",
    entry_points={"console_scripts": ["listener = worldstate_ros.node:main"]},
)
