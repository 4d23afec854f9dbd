from setuptools import setup

NAME = "regnf_ros"

setup(
    name=NAME,
    version="0.3.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/regnf.launch.py"]),
    ],
    install_requires=["setuptools", "httpx", "numpy"],
    zip_safe=True,
    maintainer="regnf contributors",
    maintainer_email="regnf@example.org",
    description="Registers detected objects with a regnf service and publishes their poses.",
    license="MIT",
    entry_points={"console_scripts": [f"register_objects = {NAME}.node:main"]},
)
