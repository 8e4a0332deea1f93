"""Find a camera that nobody has from 2D-3D correspondences (extended PnP), and how well it is known."""
