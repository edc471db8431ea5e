"""From a message of homologous points to the displacement field: stages in this process, and through the node `inverse`."""

from __future__ import annotations

import statistics
from pathlib import Path
from time import perf_counter, process_time
from typing import Any

import numpy as np

from bench.graph_client import GraphClient
from bench.scans import cpu_seconds
from brainshift_ros import graph
from brainshift_ros.atlas.file import AtlasFile, open_atlas
from brainshift_ros.correspondence.homologous import HomologousPoints
from brainshift_ros.inverse.estimate import estimate_shift
from brainshift_ros.inverse.span import atlas_span
from brainshift_ros.mesh.locate import PointLocator
from brainshift_ros.nodes.messages import to_message
from brainshift_ros.runner import Graph
from brainshift_ros.solvers.threads import one_blas_thread
from brainshift_ros.units import mm_to_m
from brainshift_ros.wire.plain import NS_PER_S
from brainshift_ros.wire.vectors import encode_field, encode_homologous

POINTS, NOISE_M, RUNS, DOMAIN = 24, 0.5e-3, 15, 87

#: Columns that are mixed to the truth, and their weights.
_MIXED, _WEIGHT = 4, 0.2


def run(atlas_path: Path) -> dict[str, list[dict[str, Any]]]:
    """Measure with noisy points of several mixtures of columns, a new one each time."""
    with open_atlas(atlas_path) as atlas:
        cases = [noisy_points(atlas, seed) for seed in range(RUNS + 1)]
        size = f"{len(atlas.mesh.nodes)} nodes, {len(atlas.entries)} columns, {POINTS} points"
        stages = in_process(atlas, cases, size)
    return {"field_stages": [stages], "field_latency": [through_node(atlas_path, cases, size)]}


def noisy_points(atlas: AtlasFile, seed: int) -> HomologousPoints:
    """Points on the surface of the craniotomy, displaced by a mixture of columns and noise."""
    rng = np.random.default_rng(seed)
    craniotomy = atlas.scene.craniotomy
    assert craniotomy is not None
    surface = np.unique(atlas.mesh.facets["skull"])
    distance = np.linalg.norm(atlas.mesh.nodes[surface] - mm_to_m(craniotomy.center_mm), axis=1)
    nodes = rng.choice(surface[distance < craniotomy.diameter_mm / 2000.0], POINTS, replace=False)
    mixed = rng.choice(len(atlas.entries), _MIXED, replace=False)
    shift = atlas.rows(nodes)[:, :, mixed].astype(np.float64).sum(axis=2) * _WEIGHT
    return HomologousPoints(atlas.mesh.nodes[nodes], shift + rng.normal(0.0, NOISE_M, shift.shape), np.full(POINTS, NOISE_M))


def in_process(atlas: AtlasFile, cases: list[HomologousPoints], size: str) -> dict[str, Any]:
    """Medians of each stage's wall time, and of the CPU time of the whole."""
    locator, span = PointLocator(atlas.mesh), atlas_span(atlas)
    stages: dict[str, list[float]] = {}
    cpu: list[float] = []
    for measured in cases:
        begin_cpu = process_time()
        with one_blas_thread():  # as the node does
            estimate = estimate_shift(atlas, measured, locator=locator, span=span)
        begin = perf_counter()
        to_message(graph.DISPLACEMENT_FIELD.type, encode_field(estimate.field, NS_PER_S))
        encode = perf_counter() - begin
        cpu.append(process_time() - begin_cpu)
        for stage, seconds in {**estimate.times_s, "encode": encode}.items():
            stages.setdefault(stage, []).append(seconds)
    counted = {stage: seconds[1:] for stage, seconds in stages.items()}  # the first one imports and allocates
    return {
        "atlas": size,
        **{f"{stage}, ms": 1e3 * statistics.median(seconds) for stage, seconds in counted.items()},
        "estimate and encode, CPU ms": 1e3 * statistics.median(cpu[1:]),
    }


def through_node(atlas_path: Path, cases: list[HomologousPoints], size: str) -> dict[str, Any]:
    """Medians as a client sees the node in a process of its own, and the node's CPU time for all three answers."""
    running = Graph({"atlas_loader": {"atlas_file": str(atlas_path.resolve())}}, domain_id=DOMAIN, sink=lambda *_: None)
    running.start("atlas_loader")
    pid = running.start("inverse").popen.pid
    awaited = (graph.DISPLACEMENT_FIELD, graph.SHIFT_ESTIMATE, graph.DISPLACEMENT_MARKERS)
    laps: list[list[float]] = []
    try:
        with GraphClient("inverse", DOMAIN, [graph.HOMOLOGOUS_POINTS], awaited) as client:
            client.until(lambda: "is open" in client.figures.get("atlas", ""), "the atlas")
            client.wait_for_subscribers()
            for number, measured in enumerate(cases, start=1):
                begin = cpu_seconds(pid)
                message = encode_homologous(measured, number * NS_PER_S)
                seconds = client.seconds_to(awaited, graph.HOMOLOGOUS_POINTS, message)
                client.wait_for_figure("estimates", number)
                laps.append([*seconds, client.figure("time_message_to_field_s"), cpu_seconds(pid) - begin])
    finally:
        running.stop()
    field, text, markers, inside, cpu = 1e3 * np.median(laps[1:], axis=0)
    return {
        "atlas": size,
        "points to field, ms": field,
        "points to field, slowest, ms": 1e3 * max(lap[0] for lap in laps[1:]),
        "message's arrival to field's publication, in the node, ms": inside,
        "points to estimate, ms": text,
        "points to markers, ms": markers,
        "all three, node's CPU ms": cpu,
    }
