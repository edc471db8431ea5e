"""Which conditions the simulated case of a number has, and how it can be made worse."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from brainshift_ros.simulation.scanner import Scanner

#: Cases in which each combination of tags and shift class comes once.
CASES_A_ROUND = 36
#: Places of the craniotomy, mm in the template's space: frontal, parietal and temporal on both sides.
PLACES_MM: dict[tuple[str, str], tuple[float, float, float]] = {
    ("frontal", "left"): (-35.0, 45.0, 50.0),
    ("frontal", "right"): (36.0, 40.0, 52.0),
    ("parietal", "left"): (-38.0, -38.0, 62.0),
    ("parietal", "right"): (40.0, -42.0, 60.0),
    ("temporal", "left"): (-62.0, -8.0, 8.0),
    ("temporal", "right"): (64.0, -14.0, 4.0),
}
#: Greatest shift over the opening, mm: a class is drawn from evenly, and the last reaches 25 to 30 mm once in three.
SHIFT_CLASSES_MM = ((3.0, 6.0), (6.0, 12.0), (12.0, 18.0), (18.0, 25.0))
LARGEST_SHIFT_MM = 30.0


_BRAINS_A_ROUND = 4


@dataclass(frozen=True)
class CasePlan:
    """What a case shall contain; the rest is chance.

    Attributes
    ----------
    brain
        Number of the brain.
    place
        Lobe and side of the craniotomy, a key of `PLACES_MM`.
    shift_mm
        Between which the greatest shift over the opening lies.
    cavity, instruments
        Whether the later scan has a resection cavity, and instruments (then the first has some in one of two cases).
    """

    brain: int
    place: tuple[str, str]
    shift_mm: tuple[float, float]
    cavity: bool
    instruments: bool

    @property
    def tags(self) -> frozenset[str]:
        """The plan in words."""
        tags = {*self.place, f"shift {self.shift_mm[0]:g}-{self.shift_mm[1]:g} mm"}
        return frozenset(tags | ({"cavity"} if self.cavity else set()) | ({"instruments"} if self.instruments else set()))


def case_plan(number: int) -> CasePlan:
    """Say what the case of a number contains: each 36 in a row cover all combinations evenly."""
    round_number, in_round = divmod(number, CASES_A_ROUND)
    deal = np.random.default_rng([round_number, 5])
    kinds = _BRAINS_A_ROUND, len(PLACES_MM)
    in_this_round, place = (int(deal.permutation(np.arange(CASES_A_ROUND) % count)[in_round]) for count in kinds)
    classes = len(SHIFT_CLASSES_MM)
    low_mm, high_mm = SHIFT_CLASSES_MM[number % classes]
    if number % classes == classes - 1 and number // classes % 3 == 0:
        low_mm, high_mm = high_mm, LARGEST_SHIFT_MM
    return CasePlan(
        brain=_BRAINS_A_ROUND * round_number + in_this_round,
        place=list(PLACES_MM)[place],
        shift_mm=(low_mm, high_mm),
        cavity=number % 3 == 1,
        instruments=number // 3 % 3 == 1,
    )


@dataclass(frozen=True)
class Severity:
    """What is made worse than the case of a number has it; all else stays. None: as drawn.

    Attributes
    ----------
    shift_mm
        Greatest shift over the opening.
    dropout_fraction, range_noise_m
        Of the scanner.
    segmentation_error_m
        Standard deviation of the patient model's smooth error along the normals.
    blood_share
        Share of the later cortex under a film of blood.
    """

    shift_mm: float | None = None
    dropout_fraction: float | None = None
    range_noise_m: float | None = None
    segmentation_error_m: float | None = None
    blood_share: float = 0.0

    def worsened(self, scanner: Scanner) -> Scanner:
        """Return the scanner with its share of lost points and its noise as asked for."""
        dropout, noise = self.dropout_fraction, self.range_noise_m
        return replace(
            scanner,
            dropout_fraction=scanner.dropout_fraction if dropout is None else dropout,
            range_noise_m=scanner.range_noise_m if noise is None else noise,
        )
