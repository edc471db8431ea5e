"""Whether a registration can be right: asked before labels are made of it."""

from __future__ import annotations

import numpy as np

from brainshift_ros.errors import InputError
from brainshift_ros.segmentation.likeness import Likeness
from brainshift_ros.segmentation.register import LinearRegistration
from brainshift_ros.segmentation.template_map import TemplateMap

_SOURCE = "segmentation"
_REMEDY = "check the image's orientation (qform, sform) and that it is a T1 of a head; else give --labels"

#: Correlation ratio after the affine part. Synthetic patients have 0.50 to 0.61, those with noise of 20 %, tilted by 25
#: degrees, of 3 mm slices or cut by the edge among them. Heads upside down, back to front, on their side, inverted or of a
#: wrong size, other bright bodies and noise have 0.13 and less.
_LEAST_RATIO, _USUAL_RATIO = 0.25, 0.4
#: Share of the brain inside the image.
_LEAST_SEEN, _WHOLE_SEEN = 0.4, 0.99
#: Stretch along the principal axes against the template, which is larger than most brains.
_POSSIBLE_STRETCH, _USUAL_STRETCH = (0.6, 1.5), (0.75, 1.25)


def check_linear(linear: LinearRegistration, alike: Likeness) -> tuple[str, ...]:
    """Judge the affine part by the image; returns what a person should know.

    Parameters
    ----------
    linear
        What was found.
    alike
        The two images under it.

    Raises
    ------
    InputError
        It cannot be a T1 of a head in the orientation that its affine says.
    """
    if alike.seen < _LEAST_SEEN:
        raise InputError(_SOURCE, f"only {alike.seen:.0%} of a brain would lie inside the image", _REMEDY)
    if alike.correlation_ratio < _LEAST_RATIO:
        problem = f"the image does not look like a head (correlation ratio {alike.correlation_ratio:.2f} to the template)"
        raise InputError(_SOURCE, problem, _REMEDY)
    stretch = np.linalg.svd(linear.T_affine[:3, :3], compute_uv=False)
    text = " x ".join(f"{s:.2f}" for s in stretch)
    if stretch.min() < _POSSIBLE_STRETCH[0] or stretch.max() > _POSSIBLE_STRETCH[1]:
        raise InputError(_SOURCE, f"the brain would measure {text} times the template", _REMEDY)
    warnings = []
    if alike.seen < _WHOLE_SEEN:
        warnings.append(f"the brain is cut by the image's edge: about {1.0 - alike.seen:.0%} of it lies outside the image")
    if alike.correlation_ratio < _USUAL_RATIO:
        warnings.append(f"the image looks little like the template ({alike.correlation_ratio:.2f}): look at the labels on it")
    if stretch.min() < _USUAL_STRETCH[0] or stretch.max() > _USUAL_STRETCH[1]:
        warnings.append(f"the brain measures {text} times the template: look at the labels on the MR")
    return tuple(warnings)


def check_map(template_map: TemplateMap) -> tuple[str, ...]:
    """Judge the whole map by itself; returns what a person should know."""
    folded = float(np.mean(template_map.jacobian_determinant() <= 0.0))
    return (f"the map folds in {folded:.2%} of the template: look at the labels on the MR",) if folded > 0.0 else ()
