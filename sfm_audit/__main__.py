"""``python -m sfm_audit``: the command line, where the script ``sfm-audit`` is not on the path."""

from sfm_audit.audit.cli.main import entry_point

if __name__ == "__main__":
    entry_point()
