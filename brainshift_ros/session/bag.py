"""The scans of a recorded case through a session, without ROS: registration, later scans, homologous points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from brainshift_ros.bags import Recorded, read_bag
from brainshift_ros.correspondence.guides_file import GuideMarks
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.errors import InputError
from brainshift_ros.graph import LRS_INITIAL_POSE, LRS_POINTS
from brainshift_ros.registration.fiducials import FiducialRegistration
from brainshift_ros.registration.scan import OrganisedScan
from brainshift_ros.session.session import LrsSession, LrsUpdate
from brainshift_ros.wire.pose import decode_pose
from brainshift_ros.wire.scan import decode_scan
from brainshift_ros.wire.stamps import ScanStamps

#: Takes a line for the person: what it is about, and what came of it.
Say = Callable[[str, str], None]


@dataclass(frozen=True)
class TrackedBag:
    """What a recorded case gives.

    Attributes
    ----------
    first, last
        The scan that was registered and the last one after it, both in the patient frame.
    homologous
        Points of the first scan found again in the last, patient frame.
    """

    first: OrganisedScan
    last: OrganisedScan
    homologous: HomologousPoints


def track_bag(
    session: LrsSession,
    path: str | Path,
    say: Say,
    *,
    fiducials: FiducialRegistration | None = None,
    marks: GuideMarks | None = None,
) -> TrackedBag:
    """Register the first usable scan of a bag and find its points in the later ones.

    Parameters
    ----------
    session
        A new one.
    path
        A rosbag2 folder or an mcap file with scans, and with a pose or without.
    say
        Told of each scan, also of those that cannot be used and are passed over.
    fiducials
        Where the registration starts; without them at the bag's first pose, and without one the cortex is searched.
    marks
        A person's, in the first and the last scan.

    Raises
    ------
    InputError
        The bag cannot be read or holds no scan; no scan can be registered; none comes after it; nothing is found in the last.
    """
    messages = read_bag(path, [LRS_POINTS, LRS_INITIAL_POSE], require=[LRS_POINTS])
    poses = [decode_pose(item.message()) for item in messages if item.topic == LRS_INITIAL_POSE]
    if fiducials is not None:
        _tell(say, "fiducials", session.set_fiducials(fiducials))
    elif poses:
        session.set_initial_pose(poses[0])
    run = _Run(session, say)
    for number, message in enumerate((item for item in messages if item.topic == LRS_POINTS), start=1):
        run.take(f"scan {number}", message)
    if run.first is None:
        raise InputError(path, f"no scan of it could be registered ({run.refusal})", "see what was said of each scan")
    for pose in poses if fiducials is not None else poses[1:]:
        _tell(say, "pose", session.set_initial_pose(pose))
    if run.last is None:
        raise InputError(path, "no usable scan came after the one that was registered", "record a scan after the shift too")
    found = run.homologous
    if marks is not None:
        guided = session.set_guides(marks)
        _tell(say, "guides", guided)
        found = guided.homologous
    if found is None or len(found.points) == 0:
        problem = f"its last scan shows nothing of the first again ({run.refusal})"
        raise InputError(path, problem, "mark pairs of points in both pictures in a guides file")
    return TrackedBag(run.first, run.last, found)


@dataclass
class _Run:
    """Scans of a bag on their way through a session."""

    session: LrsSession
    say: Say
    first: OrganisedScan | None = None
    last: OrganisedScan | None = None
    homologous: HomologousPoints | None = None
    refusal: str = "none was usable"
    _stamps: ScanStamps = field(default_factory=ScanStamps)

    def take(self, name: str, message: Recorded) -> None:
        """Place and compare a scan; a refusal is told, and the next scan has its chance."""
        try:
            scan = decode_scan(message.message())
            admitted = self._stamps.admit(scan)
            if admitted.warnings:
                self.say(name, "; ".join(admitted.warnings))
            if not admitted.duplicate:
                self._place(name, scan)
        except InputError as error:
            self.refusal = str(error)
            self.say(name, f"passed over: {error}")

    def _place(self, name: str, scan: OrganisedScan) -> None:
        placed = self.session.place(scan)
        if placed.registration is None:
            placed = self.session.search() or placed
        if self.first is None:
            _tell(self.say, name, placed)
        if placed.registered is None:
            self.refusal = "; ".join(placed.warnings)
        elif self.first is None:
            self.session.compare()  # prepared here: a first scan without vessels gives way to the next
            self.first = placed.registered
        else:
            self.last, self.homologous = placed.registered, None
            compared = self.session.compare()
            if compared is not None:
                _tell(self.say, name, compared)
                self.homologous = compared.homologous


def _tell(say: Say, name: str, update: LrsUpdate | None) -> None:
    """Put an update's figures and warnings into a line."""
    if update is None:
        return
    shown = {key: update.diagnostics[key] for key in _SHOWN if key in update.diagnostics}
    figures: Sequence[str] = [_SHOWN[key].format(value) for key, value in shown.items()]
    say(name, "; ".join((*figures, *update.warnings)) or "nothing to tell")


#: Figures that a person is told, in this order.
_SHOWN = {
    "state": "{}",
    "registration_start": "from {}",
    "registration_rms_mm": "RMS {:.2f} mm",
    "registration_inlier_fraction": "{:.0%} inliers",
    "registration_predicted_tre_mm": "predicted TRE {:.2f} mm",
    "fiducials": "{:.0f} pairs",
    "fre_mm": "FRE {:.2f} mm",
    "fiducials_predicted_tre_mm": "predicted TRE {:.2f} mm",
    "pose_disagreement_mm": "{:.1f} mm from the registration",
    "homologous_points": "{:.0f} homologous points",
    "shift_mm_mean": "moved {:.1f} mm on average",
    "shift_mm_max": "{:.1f} mm at most",
}
