"""Where the brain is in an image, roughly: starts for the rigid registration."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from skimage.filters import threshold_otsu

from brainshift_ros.errors import InputError
from brainshift_ros.image.grid import Grid
from brainshift_ros.image.labels import largest_component
from brainshift_ros.image.volume import Volume
from brainshift_ros.units import mm_to_m

#: From the vertex down: a brain with its skull is about this high; what lies below is face and neck.
_HEAD_HEIGHT_MM = 160.0


def brain_centres(t1: Volume) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Guess the centre of the brain, twice; each of shape (3,), metres.

    The first lies half a head's height below the vertex, the second midway between the ends of what is bright within a
    head's height. They agree unless the image cuts the head: the first is right if it is cut below, the second may be
    nearer if it is cut above.

    Parameters
    ----------
    t1
        Whole head, or a stripped brain, which is nearly as high.

    Raises
    ------
    InputError
        All voxels are equal.
    """
    if t1.data.min() == t1.data.max():
        raise InputError("T1", "all voxels are equal", "give an image with the head in it")
    head = largest_component(t1.data > threshold_otsu(t1.data))
    points = Grid.of(t1).centres(np.argwhere(head))
    height = mm_to_m(_HEAD_HEIGHT_MM)
    top = np.quantile(points[:, 2], 0.995)
    upper = points[points[:, 2] > top - height]
    between = 0.5 * (upper.min(axis=0) + upper.max(axis=0))
    below_vertex = np.array([between[0], between[1], top - 0.5 * height])
    return below_vertex, between
