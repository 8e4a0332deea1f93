"""What can go wrong with a cluster; the message is one line for the user."""

from __future__ import annotations


class ClusterError(Exception):
    """The Dask cluster cannot be used or was lost: which one, what is wrong, what to do."""
