"""2D-3D correspondences of one image, with the 3D neighbours that a lidar scan gives its points."""

from __future__ import annotations

from dataclasses import dataclass

from sfm_audit.loaders.arrays import FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Correspondences:
    """Correspondences and size of one image; row i of every array is the same correspondence.

    width, height: of the image, px.               xy_px: (n, 2) observed, distorted; first pixel centre = (0.5, 0.5).
    xyz_world: (n, 3) model units.                 pan_xyz_world, tilt_xyz_world: (n, 3) the next points of the scan in
    pan (the horizontal angle) and in tilt, model units; both None where the points come from elsewhere.
    """

    width: int
    height: int
    xy_px: FloatArray
    xyz_world: FloatArray
    pan_xyz_world: FloatArray | None = None
    tilt_xyz_world: FloatArray | None = None

    @property
    def num(self) -> int:
        """Correspondences."""
        return len(self.xy_px)

    @property
    def has_neighbours(self) -> bool:
        """Whether the lidar noise model can be used."""
        return self.pan_xyz_world is not None and self.tilt_xyz_world is not None
