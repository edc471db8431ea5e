"""Run by an interpreter that has open3d or small_gicp: their ICP of one scan from many starts. No project imports.

Both get millimetres: small_gicp's covariances and Open3D's criteria are made for numbers of that size, and in metres both stop
at once.
"""

from __future__ import annotations

import importlib.util
import sys
import time
import types
from collections.abc import Callable
from pathlib import Path

import numpy as np

_DISTANCES = (10.0, 5.0, 2.5)
_VOXELS = (4.0, 2.5, 1.2)
_ITERATIONS = 40


def compiled_open3d() -> types.ModuleType:
    """Open3D's compiled part alone: the package around it asks for dozens of others, for pictures and notebooks."""
    package = importlib.util.find_spec("open3d")
    if package is None or package.submodule_search_locations is None:
        raise ImportError("open3d is not installed")
    library = next(Path(package.submodule_search_locations[0], "cpu").glob("pybind*.so"))
    for parent in ("open3d", "open3d.cpu"):
        sys.modules[parent] = types.ModuleType(parent)
    spec = importlib.util.spec_from_file_location("open3d.cpu.pybind", library)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def open3d_aligner(source: np.ndarray, target: np.ndarray, normals: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Robust point-to-plane ICP (Tukey), coarse to fine."""
    o3d = compiled_open3d()
    icp = o3d.pipelines.registration

    def cloud(points: np.ndarray):  # type: ignore[no-untyped-def]
        return o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))

    fixed = cloud(target)
    fixed.normals = o3d.utility.Vector3dVector(normals)
    moving = [cloud(source).voxel_down_sample(voxel) for voxel in _VOXELS]
    criteria = icp.ICPConvergenceCriteria(1e-7, 1e-7, _ITERATIONS)

    def align(pose: np.ndarray) -> np.ndarray:
        for cloud_at, distance in zip(moving, _DISTANCES, strict=True):
            kernel = icp.TransformationEstimationPointToPlane(icp.TukeyLoss(distance))
            pose = icp.registration_icp(cloud_at, fixed, distance, pose, kernel, criteria).transformation
        return np.asarray(pose)

    return align


def small_gicp_aligner(source: np.ndarray, target: np.ndarray, _: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
    """Generalised ICP, coarse to fine; it takes its covariances from the points themselves."""
    import small_gicp

    stages = [
        (small_gicp.preprocess_points(target, voxel, num_threads=1), small_gicp.preprocess_points(source, voxel, num_threads=1))
        for voxel in _VOXELS
    ]

    def align(pose: np.ndarray) -> np.ndarray:
        for ((fixed, tree), (moving, _)), distance in zip(stages, _DISTANCES, strict=True):
            pose = small_gicp.align(
                fixed,
                moving,
                tree,
                init_T_target_source=pose,
                registration_type="GICP",
                max_correspondence_distance=distance,
                num_threads=1,
                max_iterations=_ITERATIONS,
            ).T_target_source
        return np.asarray(pose)

    return align


PEERS = {"Open3D": open3d_aligner, "small_gicp": small_gicp_aligner}


def main(folder: Path) -> None:
    """Read problem.npz (source, target, normals, starts; mm), write the poses and CPU seconds of each peer that is there."""
    with np.load(folder / "problem.npz") as problem:
        source, target, normals, starts = (problem[name] for name in ("source", "target", "normals", "starts"))
    made = {}
    for name, aligner in PEERS.items():
        try:
            align = aligner(source, target, normals)
        except ImportError:  # no wheel for this Python, or a system library is missing
            continue
        clock = time.process_time()
        made[f"{name} poses"] = np.array([align(start) for start in starts])
        made[f"{name} cpu_s"] = np.array((time.process_time() - clock) / len(starts))
    np.savez(folder / "answer.npz", **made)  # type: ignore[arg-type]


if __name__ == "__main__":
    main(Path(sys.argv[1]))
