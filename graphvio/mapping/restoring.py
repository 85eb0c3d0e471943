"""From what is kept on disk to a graph that goes on, and back."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from graphvio.config import Config
from graphvio.mapping.chains import Chains
from graphvio.mapping.pose_graph import Judged, PoseGraph
from graphvio.mapping.recognition import Recognition
from graphvio.mapping.saved_map import SavedMap
from graphvio.optimization.loops.closures import Place
from graphvio.optimization.solver import Edge


def to_saved(graph: PoseGraph, recognition: Recognition, places: Sequence[Place]) -> SavedMap:
    """All that has to be kept, of the places that the graph holds."""
    chains, closures, n = graph.chains, graph.closures, len(graph)
    pairs = [recognition.pairs(place) for place in range(n)]
    size = recognition.words.size
    return SavedMap(
        session=np.array([place.session for place in places[:n]], dtype=np.int64),
        stamp_ns=np.array([place.stamp_ns for place in places[:n]], dtype=np.int64),
        map_T_body=np.array([graph.pose(k) for k in range(n)]).reshape(-1, 4, 4),
        covariance=np.array([graph.covariance(k) for k in range(n)]).reshape(-1, 6, 6),
        starts=np.array(chains.starts, dtype=np.int64),
        component=np.array(graph.component, dtype=np.int64),
        firsts=np.array([chains.poses[start] for start in chains.starts]).reshape(-1, 4, 4),
        motions=np.array(chains.motions).reshape(-1, 4, 4),
        motion_covariances=np.array(chains.covariances).reshape(-1, 6, 6),
        words=recognition.words,
        learnt_from=recognition.learnt_from,
        vectors=np.concatenate([np.zeros((0, size)), *(recognition.vectors(place) for place in range(n))]),
        vector_place=np.repeat(np.arange(n), [len(each) for each in pairs]),
        vector_pair=np.concatenate([np.zeros(0, dtype=np.int64), *pairs]),
        closures=[each.closure for each in closures],
        is_used=np.array([each.is_used for each in closures], dtype=bool),
        is_refuted=np.array([each.is_refuted for each in closures], dtype=bool),
    )


def restored(kept: SavedMap, config: Config) -> tuple[PoseGraph, Recognition, list[Place]]:
    """The graph as it was, what its places look like, and the places."""
    chains = Chains.of(kept.starts.tolist(), kept.firsts, kept.motions, kept.motion_covariances)
    closures = [
        Judged(
            each,
            Edge(each.reference.row, each.current.row, each.reference_T_current, each.covariance),
            bool(is_used),
            bool(is_refuted),
        )
        for each, is_used, is_refuted in zip(kept.closures, kept.is_used, kept.is_refuted, strict=True)
    ]
    probability = config.optimization.loop_probability
    graph = PoseGraph(
        probability, chains, closures, list(kept.map_T_body), kept.component.tolist(), list(kept.covariance)
    )
    recognition = Recognition(config.motion.seed, kept.words, kept.learnt_from)
    for k in range(len(kept.stamp_ns)):
        rows = np.flatnonzero(kept.vector_place == k)
        recognition.add_described(kept.vector_pair[rows].tolist(), list(kept.vectors[rows]))
    places = [
        Place(session, k, stamp_ns)
        for k, (session, stamp_ns) in enumerate(zip(kept.session.tolist(), kept.stamp_ns.tolist(), strict=True))
    ]
    return graph, recognition, places
