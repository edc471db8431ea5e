"""The template as a patient: T1 with a drawn tumour, labels, septa; the demo's and the tests' case."""

from __future__ import annotations

from dataclasses import dataclass

from brainshift_ros.image.template import template_labels, template_landmarks, template_t1
from brainshift_ros.image.tumor import TumorShape, draw_tumor
from brainshift_ros.image.volume import Volume
from brainshift_ros.septa.sheets import Septum
from brainshift_ros.septa.template import septa_from_template


@dataclass(frozen=True)
class TemplateImages:
    """What a patient model is built from.

    Attributes
    ----------
    t1, labels
        On the template's 1 mm grid.
    septa
        Falx, left and right tentorium.
    """

    t1: Volume
    labels: Volume
    septa: tuple[Septum, ...]


def template_patient_images(tumor: TumorShape | None = None, septa_spacing_mm: float = 5.0) -> TemplateImages:
    """Draw a tumour, by default 3 cm in the left frontal lobe, into the MNI152 template and build its septa.

    Parameters
    ----------
    tumor
        Its place and shape.
    septa_spacing_mm
        Distance between vertices of the septa; about the mesh's edge length serves best.
    """
    landmarks = template_landmarks()
    t1, labels = draw_tumor(template_t1(), template_labels(landmarks), tumor)
    return TemplateImages(t1, labels, septa_from_template(lambda points: points, septa_spacing_mm))
