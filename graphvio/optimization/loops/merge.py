"""Feature databases of parts of a session, joined to the one that a single run would have made."""

from __future__ import annotations

from collections.abc import Sequence

from graphvio.optimization.loops.database import FeatureDatabase, image_name
from graphvio.rig import Rig


def merge_places(
    part: FeatureDatabase, whole: FeatureDatabase, session: str, rig: Rig, stamps_ns: Sequence[int]
) -> None:
    """Copy places from one database into another.

    Parts that are copied in the order of time give the rows that `extract_places` gives for all places at once.

    Args:
        part: holds some of the places.
        whole: to write.
        session: name of the session.
        rig: its cameras.
        stamps_ns: of the places, in the order of time; those that the part does not hold are passed over.
    """
    for stamp_ns in stamps_ns:
        names = {
            camera.name: image_name(session, camera.name, stamp_ns)
            for pair in rig.pairs
            for camera in (pair.left, pair.right)
        }
        names = {camera: name for camera, name in names.items() if name in part.names and name not in whole.names}
        if not names:
            continue
        with whole.transaction():
            rig_id, cameras = whole.rig_of(session, rig) or whole.add_rig(rig)
            whole.add_place(rig_id, {cameras[camera]: name for camera, name in names.items()})
            for pair in rig.pairs:
                if pair.left.name in names:
                    left, right = names[pair.left.name], names[pair.right.name]
                    whole.add_features(left, part.pixels(left), part.descriptors(left))
                    whole.add_features(right, part.pixels(right))
                    whole.add_matches(left, right, part.matches(left, right))
