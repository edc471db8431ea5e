"""ament_python package: `colcon build` puts executables where `ros2 run` finds them, `pip install` where a shell does."""

from glob import glob
from pathlib import Path

from setuptools import find_packages, setup

PACKAGE = "brainshift_ros"
HERE = Path(__file__).parent


def pinned(name: str) -> list[str]:
    """Requirements of a file in requirements/, comments dropped."""
    lines = (HERE / "requirements" / name).read_text(encoding="utf-8").splitlines()
    return [line.split("#")[0].strip() for line in lines if line.split("#")[0].strip()]


namespace: dict[str, str] = {}
exec((HERE / PACKAGE / "__init__.py").read_text(encoding="utf-8"), namespace)

setup(
    name=PACKAGE,
    version=namespace["__version__"],
    description="Atlas-based brain shift compensation for image-guided neurosurgery (research software)",
    license="Apache-2.0",
    python_requires=">=3.11,<3.14",
    packages=find_packages(include=[PACKAGE, f"{PACKAGE}.*"]),
    package_data={PACKAGE: ["py.typed", "**/*.json"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/config", sorted(glob("config/*"))),
        (f"share/{PACKAGE}/launch_scripts", sorted(glob("launch_scripts/*.launch.py"))),
    ],
    install_requires=pinned("runtime.txt"),
    extras_require={"test": ["pytest", "hypothesis", "jsonschema"]},
    zip_safe=True,
    entry_points={
        "console_scripts": [
            "brainshift = brainshift_ros.cli.main:main",
            "atlas_loader = brainshift_ros.nodes.atlas_loader:main",
            "lrs = brainshift_ros.nodes.lrs:main",
            "retractor = brainshift_ros.nodes.retractor:main",
            "inverse = brainshift_ros.nodes.inverse:main",
        ],
    },
)
