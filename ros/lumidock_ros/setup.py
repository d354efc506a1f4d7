"""Installs the node with its launch file, parameters and layouts."""

from pathlib import Path

from setuptools import setup

NAME = "lumidock_ros"
SHARED = ("launch", "config", "rviz", "foxglove", "rerun")

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        *((f"share/{NAME}/{folder}", [str(file) for file in sorted(Path(folder).iterdir())]) for folder in SHARED),
    ],
    install_requires=["setuptools", "lumidock[bag]"],
    entry_points={"console_scripts": [f"node = {NAME}.node:main"]},
)
