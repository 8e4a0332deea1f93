"""COLMAP model folders, binary and text, and its database."""
