"""Rig files: graphvio's own ``rig.yaml``, and readers for the calibrations of other systems and data sets."""

from graphvio.rig_files.joining import joined_rig
from graphvio.rig_files.loading import find_rig, load_rig
from graphvio.rig_files.native import save_rig

__all__ = ["find_rig", "joined_rig", "load_rig", "save_rig"]
