"""Grey and white matter by an intensity threshold per element, tumour by region (spec P6)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from skimage.filters import threshold_otsu

from brainshift_ros.errors import InputError
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


def classify_tissue(mesh: TetMesh, t1: Volume, threshold: float | None = None) -> tuple[NDArray[np.uint8], tuple[str, ...]]:
    """Tell white matter, which is bright on a T1, from grey.

    Parameters
    ----------
    mesh
        With facets ``skull`` and the tumour's region.
    t1
        The MR; on a T2 white matter is the darker one.
    threshold
        Intensity above which an element is white; None takes Otsu's (1979) over the elements outside the tumour.

    Returns
    -------
    tissue : ndarray
        Shape (M,), :class:`~brainshift_ros.mesh.patient.Tissue`.
    warnings : tuple of str
        Whether the brightness is that of a T1: white matter lies deeper than grey.

    Raises
    ------
    InputError
        The threshold leaves no grey or no white element.
    """
    intensity = mean_intensity(mesh, t1)
    tumor = mesh.region == Region.TUMOR
    limit = float(threshold_otsu(intensity[~tumor])) if threshold is None else threshold
    white = intensity > limit
    share = float(white[~tumor].mean())
    if threshold is not None and share in (0.0, 1.0):
        low, high = intensity[~tumor].min(), intensity[~tumor].max()
        problem = f"is {threshold:g}, but the elements' intensities run from {low:.4g} to {high:.4g}"
        raise InputError("tissue threshold", problem, "give one between, in the MR's intensity")
    tissue = np.where(white, Tissue.WHITE, Tissue.GREY).astype(np.uint8)
    tissue[tumor] = Tissue.TUMOR
    depth, _ = cKDTree(mesh.nodes[np.unique(mesh.facets["skull"])]).query(mesh.nodes[mesh.elements].mean(axis=1))
    if depth[white & ~tumor].mean() > depth[~white & ~tumor].mean():
        return tissue, ()
    return tissue, ("bright tissue lies no deeper than dark tissue: grey and white are right only on a T1",)
