"""Grey and white matter by an intensity threshold per element, tumour by region (spec P6)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from skimage.filters import threshold_otsu

from brainshift_ros.image.resample import sample
from brainshift_ros.image.volume import Region, Volume
from brainshift_ros.mesh.patient import Tissue
from brainshift_ros.mesh.tetmesh import TetMesh

# Points of the four-point Gauss rule (degree 2) in barycentric coordinates.
_A, _B = 0.5854101966249685, 0.1381966011250105
_GAUSS4 = np.full((4, 4), _B) + (_A - _B) * np.eye(4)


def mean_intensity(mesh: TetMesh, t1: Volume) -> NDArray[np.float64]:
    """Mean T1 intensity of each element, shape (M,): four Gauss points and the centre."""
    x = mesh.nodes[mesh.elements]
    points = np.concatenate([np.einsum("gi,mik->mgk", _GAUSS4, x), x.mean(axis=1, keepdims=True)], axis=1)
    return sample(t1, points, "linear").mean(axis=1)


def classify_tissue(mesh: TetMesh, t1: Volume) -> NDArray[np.uint8]:
    """Tissue of each element, shape (M,): white above Otsu's threshold (1979) of the T1, grey below, tumour by region."""
    intensity = mean_intensity(mesh, t1)
    tumor = mesh.region == Region.TUMOR
    threshold = threshold_otsu(intensity[~tumor])
    tissue = np.where(intensity > threshold, Tissue.WHITE, Tissue.GREY).astype(np.uint8)
    tissue[tumor] = Tissue.TUMOR
    return tissue
