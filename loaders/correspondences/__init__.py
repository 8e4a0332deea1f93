"""2D-3D correspondences of one image, from tables and scans."""
