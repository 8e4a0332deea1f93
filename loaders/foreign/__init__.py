"""Reconstructions that other programs than COLMAP wrote: one file per format, facts first."""
