"""The graph declares each topic once, completely, and as the specification's table has it."""

from __future__ import annotations

import re

import pytest

from brainshift_ros import graph
from brainshift_ros.bags import TYPES
from brainshift_ros.errors import InputError

#: The specification's table: node -> what it takes and what it gives.
SPECIFIED = {
    "atlas_loader": (set(), {"atlas/info", "atlas/surface", "/diagnostics"}),
    "lrs": (
        {"lrs/points", "lrs/initial_pose"},
        {"registration/patient_from_tracker", "lrs/registered", "homologous_points", "dense_points", "/diagnostics"},
    ),
    "retractor": (
        {"retractor/blade", "retractor/displacement"},
        {"atlas/retraction", "retractor/status", "/diagnostics"},
    ),
    "inverse": (
        {"atlas/info", "atlas/retraction", "homologous_points"},
        {"displacement_field", "displacement_markers", "shift_estimate", "/diagnostics"},
    ),
}

LATCHED = {
    "atlas/info",
    "atlas/surface",
    "registration/patient_from_tracker",
    "homologous_points",
    "dense_points",
    "atlas/retraction",
    "displacement_field",
}


def test_nodes_take_and_give_what_the_specification_says():
    declared = {node.name: ({t.name for t in node.takes}, {t.name for t in node.gives}) for node in graph.NODES}
    assert declared == SPECIFIED


def test_each_topic_is_declared_once_and_used():
    names = [topic.name for topic in graph.TOPICS]
    assert len(set(names)) == len(names)
    used = {topic for node in graph.NODES for topic in (*node.takes, *node.gives)}
    assert used == set(graph.TOPICS)
    held = {value for value in vars(graph).values() if isinstance(value, graph.Topic)}
    assert held == set(graph.TOPICS), "a topic is declared but not listed in TOPICS"


def test_what_must_be_latched_is_latched():
    assert {topic.name for topic in graph.TOPICS if topic.qos is graph.Qos.LATCHED} >= LATCHED


@pytest.mark.parametrize("topic", graph.TOPICS, ids=lambda topic: topic.name)
def test_a_topic_is_complete(topic):
    assert re.fullmatch(r"/?[a-z_]+(/[a-z_]+)*", topic.name)
    fields = dict(TYPES.fielddefs[topic.type][1])
    if "header" in fields and topic is not graph.DIAGNOSTICS:
        assert topic.frame in (graph.PATIENT_FRAME, graph.TRACKER_FRAME)
    if topic is not graph.DIAGNOSTICS:
        assert topic.units


def test_services_belong_to_nodes():
    assert {service.node for service in graph.SERVICES} <= {node.name for node in graph.NODES}
    assert {service.type for service in graph.SERVICES} == {"std_srvs/srv/Trigger"}


def test_only_inputs_that_nothing_gives_make_a_case():
    given = {topic for node in graph.NODES for topic in node.gives}
    taken = {topic for node in graph.NODES for topic in node.takes}
    assert set(graph.CASE_INPUTS) == taken - given


def test_topics_are_found_by_name():
    assert graph.topics_named(["/lrs/points", "diagnostics"]) == [graph.LRS_POINTS, graph.DIAGNOSTICS]
    with pytest.raises(InputError, match=r"the graph has no lrs/point; choose from atlas/info, "):
        graph.topics_named(["lrs/point"])
