"""Optimise a recording as a whole, and open the result as a COLMAP model, as dense reconstruction takes it.

    pip install '.[maps]'          # in a clone of graphvio
    python batch_to_colmap.py RECORDING NEW_FOLDER

graphvio is imported before pycolmap: in the other order the two libraries' allocators do not agree, and the process is
aborted during the optimisation.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import graphvio  # isort: skip
import graphvio.optimization.pipeline  # isort: skip  # before pycolmap, as it loads gtsam
import pycolmap  # isort: skip


def main() -> None:
    """Optimise, and print what the model holds."""
    folder = Path(sys.argv[2])
    found = graphvio.optimize_sessions([graphvio.open_source(sys.argv[1])], folder, graphvio.Config())
    print(f"half the squared residuals: {found.cost_before:.1f} before, {found.cost_after:.1f} after")
    print(f"loop closures: {len(found.edges)} used, of {len(found.loops)} found")

    for path in sorted((folder / "colmap/sparse").iterdir()):
        model = pycolmap.Reconstruction(path)
        print(
            f"{path}: {model.num_reg_frames()} frames, {model.num_reg_images()} images, {model.num_points3D()} points"
        )
        image = model.image(min(model.reg_image_ids()))
        camera = model.camera(image.camera_id)
        print(f"first image {image.name}: {camera.model_name}, centre at {np.round(image.projection_center(), 3)} m")
        errors = [point.error for point in model.points3D.values()]
        print(f"median reprojection error: {np.median(errors):.2f} px")


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    main()
