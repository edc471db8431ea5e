"""det F of displacement fields against determinants computed one by one."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from mechanics_cases import head

from brainshift_ros.image.volume import Region
from brainshift_ros.mechanics.deformation import JacobianOfElements

MESH = head(5)


@settings(max_examples=30, deadline=None)
@given(arrays(np.float64, (3, 3), elements=st.floats(-1.5, 1.5)))
def test_affine_field_has_its_own_determinant_everywhere(gradient):
    # u = A x + b: F = I + A in every element, whatever its shape; moving the whole head changes nothing.
    u = MESH.nodes @ gradient.T + 0.01
    expected = np.linalg.det(np.eye(3) + gradient)
    found = JacobianOfElements(MESH)(u[:, :, None])
    assert found.smallest[0] == pytest.approx(expected, abs=2e-4)
    if abs(expected) > 1e-3:
        assert found.inverted[0] == (len(MESH.elements) if expected < 0.0 else 0)


def test_smallest_and_inverted_of_many_fields_are_those_of_each():
    rng = np.random.default_rng(1)
    edge = 0.07 * 2 / 5
    # From hardly strained to turned inside out, in more fields than are worked on at once.
    u = rng.normal(size=(len(MESH.nodes), 3, 150)) * np.geomspace(1e-3, 1.0, 150) * edge
    found = JacobianOfElements(MESH)(u)
    x = MESH.nodes[MESH.elements]
    for field in range(150):
        y = (MESH.nodes + u[:, :, field])[MESH.elements]
        ratio = np.linalg.det(y[:, 1:] - y[:, :1]) / np.linalg.det(x[:, 1:] - x[:, :1])
        assert found.smallest[field] == pytest.approx(ratio.min(), abs=1e-4 * np.abs(ratio).max())
        assert found.inverted[field] == np.count_nonzero(ratio <= 0.0)
    assert found.inverted[0] == 0 < found.inverted[-1]


def test_elements_that_do_not_count_are_left_out():
    # All nodes of the tumour alone fall into one point: its elements vanish, and those around it stretch.
    tumor = MESH.region == Region.TUMOR
    inside = np.setdiff1d(MESH.elements[tumor], MESH.elements[~tumor])
    nodes = inside if len(inside) else np.unique(MESH.elements[tumor])
    u = np.zeros((len(MESH.nodes), 3, 1))
    u[nodes, :, 0] = MESH.nodes[nodes].mean(axis=0) - MESH.nodes[nodes] + 0.05
    everywhere, rest = JacobianOfElements(MESH)(u), JacobianOfElements(MESH, ~tumor)(u)
    assert everywhere.inverted[0] >= rest.inverted[0]
    assert everywhere.smallest[0] == min(rest.smallest[0], JacobianOfElements(MESH, np.flatnonzero(tumor))(u).smallest[0])
