"""The page of vessels and homologous points."""

from __future__ import annotations

import numpy as np
import pytest
from matplotlib.image import imread
from vessel_cases import FORK, PIXEL_M, WAVE, flat_scan

from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.errors import InputError
from brainshift_ros.pictures.scan import scan_page
from brainshift_ros.vessels.tracing import trace_vessels

PINK = (255, 79, 216)


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    folder = tmp_path_factory.mktemp("pages")
    scan = flat_scan([WAVE, *FORK], 5)
    # A flat scan is no pinhole's: a little relief keeps the projection determined.
    v, u = np.indices(scan.seen.shape)
    depth = 0.3 + 0.004 * np.sin(u / 40) * np.cos(v / 30)
    focal = 0.3 / PIXEL_M
    scan.points[:] = np.stack([(u - 160) / focal * depth, (v - 120) / focal * depth, depth], axis=-1)
    points = scan.points[[60, 150, 160], [100, 160, 250]].astype(float)
    homologous = HomologousPoints(points, np.full((3, 3), [2e-3, 1e-3, 0.0]), np.array([0.2e-3, 0.4e-3, 1.0e-3]))
    obstacle = np.zeros(scan.seen.shape, dtype=bool)
    obstacle[180:, 220:260] = True
    vessels = trace_vessels(scan)
    scan_page(folder / "alone.png", scan, vessels)
    scan_page(folder / "obstacle.png", scan, vessels, scan, homologous, later_obstacles=obstacle)
    return scan, vessels, folder


def pixels_like(path, colour):
    image = 255 * imread(path)[..., :3]
    return np.argwhere(np.abs(image - colour).max(axis=-1) < 30)


def test_obstacles_are_outlined_in_the_later_picture_only(pages):
    _, _, folder = pages
    outlined, alone = (pixels_like(folder / f"{name}.png", PINK) for name in ("obstacle", "alone"))
    assert len(outlined) > 300
    assert len(alone) == 0
    width = imread(folder / "obstacle.png").shape[1]
    in_picture = outlined[outlined[:, 0] < outlined[:, 0].max() - 30]  # below stands the legend
    assert (in_picture[:, 1] > width / 2).all()


def test_obstacles_of_another_picture_are_refused(pages, tmp_path):
    scan, vessels, _ = pages
    with pytest.raises(InputError, match="obstacles of shape"):
        scan_page(tmp_path / "page.png", scan, vessels, first_obstacles=np.zeros((3, 3), dtype=bool))
    with pytest.raises(InputError, match="obstacles of shape"):
        scan_page(tmp_path / "page.png", scan, vessels, later_obstacles=np.zeros(scan.seen.shape, dtype=bool))
    assert not (tmp_path / "page.png").exists()


def test_a_first_scan_alone_makes_a_narrower_page(pages):
    _, _, folder = pages
    assert imread(folder / "alone.png").shape[1] < imread(folder / "obstacle.png").shape[1]
